// Front-to-back compositing (H-19, H-20, G-1), one tile at a time, one block at a time.
#include <algorithm>

#include "rendering/tile.hpp"

namespace semsplat {
namespace {

// Maximum number of feature channels whose sums over a block fit into the registers.
enum { MAX_COMPOSITED = LANES == 16 ? 16 : LANES == 8 ? 12 : 6 };

struct BlockList {
    int count = 0;
    uint8_t entry[BATCH];
};

struct ForwardScratch {
    TileEntry entries[BATCH];
    BlockList lists[BLOCKS];
    alignas(64) float base[BLOCKS][SILHOUETTE][BLOCK_PIXELS];  // red, green, blue, depth of each block
    alignas(64) float weights[BATCH][BLOCK_PIXELS];            // blending weights of one block's list
    std::vector<float> features;                               // [BLOCKS, S, BLOCK_PIXELS]
};

// Composites N feature channels, starting with `first`, of the first `count` splats of a block's list.
template <int N>
SEMSPLAT_INLINE void add_features(const ForwardScratch& scratch, const BlockList& list, int count,
                                  const float* features, int channels, int first, float* sums) {
    Floats acc[N][PARTS];
    for (int c = 0; c < N; ++c) {
        for (int p = 0; p < PARTS; ++p) acc[c][p] = load(sums + BLOCK_PIXELS * (first + c) + LANES * p);
    }
    for (int k = 0; k < count; ++k) {
        const float* const f = features + (size_t)scratch.entries[list.entry[k]].id * channels + first;
        Floats w[PARTS];
        for (int p = 0; p < PARTS; ++p) w[p] = load(scratch.weights[k] + LANES * p);
        for (int c = 0; c < N; ++c) {
            for (int p = 0; p < PARTS; ++p) acc[c][p] = fma(w[p], all(f[c]), acc[c][p]);
        }
    }
    for (int c = 0; c < N; ++c) {
        for (int p = 0; p < PARTS; ++p) store(sums + BLOCK_PIXELS * (first + c) + LANES * p, acc[c][p]);
    }
}

void add_all_features(const ForwardScratch& scratch, const BlockList& list, int count, const Gaussians& map,
                      float* sums) {
    const int S = map.feature_channels;
    int first = 0;
    for (; first + MAX_COMPOSITED <= S; first += MAX_COMPOSITED) {
        add_features<MAX_COMPOSITED>(scratch, list, count, map.features, S, first, sums);
    }
    with_constant<1, MAX_COMPOSITED - 1>(S - first, [&](auto n) {
        add_features<n>(scratch, list, count, map.features, S, first, sums);
    });
    if (map.centres) add_features<3>(scratch, list, count, map.means, 3, 0, sums + BLOCK_PIXELS * S);
}

// Composites one batch into one block. Returns the number of entries used; it is smaller than the
// length of the list if the block became opaque.
template <Shape SHAPE, bool FEATURES>
int composite_block(ForwardScratch& scratch, int block, float* transmittance) {
    const BlockList& list = scratch.lists[block];
    float(*const base)[BLOCK_PIXELS] = scratch.base[block];
    Floats T[PARTS], sums[SILHOUETTE][PARTS];
    for (int p = 0; p < PARTS; ++p) {
        T[p] = load(transmittance + LANES * p);
        for (int c = 0; c < SILHOUETTE; ++c) sums[c][p] = load(base[c] + LANES * p);
    }
    const Floats cut = all(MIN_ALPHA), most = all(MAX_ALPHA), dark = all(MIN_TRANSMITTANCE);
    int n = 0;
    while (n < list.count) {
        const TileEntry& e = scratch.entries[list.entry[n]];
        uint32_t bright = 0;
        for (int p = 0; p < PARTS; ++p) {
            Floats depth;
            const Floats raw = gaussian_of<SHAPE>(e, block, p, depth);
            const Floats alpha = keep(ge(raw, cut), minimum(raw, most));
            const Floats w = alpha * T[p];
            T[p] = fnma(alpha, T[p], T[p]);  // a single rounding; T - w is inaccurate for alpha near 1
            sums[0][p] = fma(w, all(e.r), sums[0][p]);
            sums[1][p] = fma(w, all(e.g), sums[1][p]);
            sums[2][p] = fma(w, all(e.b), sums[2][p]);
            sums[3][p] = fma(w, depth, sums[3][p]);
            if (FEATURES) store(scratch.weights[n] + LANES * p, w);
            bright |= bits(ge(T[p], dark));
        }
        ++n;
        if (!bright) break;
    }
    for (int p = 0; p < PARTS; ++p) {
        store(transmittance + LANES * p, T[p]);
        for (int c = 0; c < SILHOUETTE; ++c) store(base[c] + LANES * p, sums[c][p]);
    }
    return n;
}

bool is_dark(const float* transmittance) {
    uint32_t bright = 0;
    for (int p = 0; p < PARTS; ++p) bright |= bits(ge(load(transmittance + LANES * p), all(MIN_TRANSMITTANCE)));
    return !bright;
}

void start_transmittance(const Pinhole& cam, int left, int top, float* transmittance) {
    for (int block = 0; block < BLOCKS; ++block) {
        for (int p = 0; p < BLOCK_PIXELS; ++p) {
            const int x = left + block_column(block) + (p & 3), y = top + block_row(block) + (p >> 2);
            transmittance[BLOCK_PIXELS * block + p] = x < cam.width && y < cam.height ? 1.0f : 0.0f;
        }
    }
}

// Writes one channel of a tile from block order into image rows.
void write_channel(const Pinhole& cam, int left, int top, const float* blocks, size_t stride,
                   float* image) {
    for (int block = 0; block < BLOCKS; ++block) {
        const int x = left + block_column(block), y0 = top + block_row(block);
        const int columns = std::min(4, cam.width - x);
        for (int row = 0; row < BLOCK_ROWS && y0 + row < cam.height && columns > 0; ++row) {
            std::copy_n(blocks + stride * block + 4 * row, columns,
                        image + (size_t)(y0 + row) * cam.width + x);
        }
    }
}

void write_tile(const Rasterisation& state, const ForwardScratch& scratch, int tile, int S, float* images) {
    const Pinhole& cam = state.camera;
    const size_t plane = (size_t)cam.width * cam.height;
    const int left = tile % state.tiles_x * TILE, top = tile / state.tiles_x * TILE;
    for (int c = 0; c < SILHOUETTE; ++c) {
        write_channel(cam, left, top, scratch.base[0][c], (size_t)SILHOUETTE * BLOCK_PIXELS, images + c * plane);
    }
    alignas(64) float silhouette[TILE_PIXELS];
    const float* T = state.transmittance.data() + (size_t)tile * TILE_PIXELS;
    for (int p = 0; p < TILE_PIXELS; ++p) silhouette[p] = 1.0f - T[p];
    write_channel(cam, left, top, silhouette, (size_t)BLOCK_PIXELS, images + SILHOUETTE * plane);
    for (int c = 0; c < S; ++c) {
        write_channel(cam, left, top, scratch.features.data() + BLOCK_PIXELS * c, (size_t)BLOCK_PIXELS * S,
                      images + (BASE_CHANNELS + c) * plane);
    }
}

template <Shape SHAPE, bool FEATURES>
void composite_tile(const Gaussians& map, Rasterisation& state, int tile, ForwardScratch& scratch) {
    const int left = tile % state.tiles_x * TILE, top = tile / state.tiles_x * TILE;
    const int begin = state.tile_begin[tile], count = state.tile_begin[tile + 1] - begin;
    float* const T = state.transmittance.data() + (size_t)tile * TILE_PIXELS;
    int32_t* const ends = state.block_end.data() + (size_t)tile * BLOCKS;
    start_transmittance(state.camera, left, top, T);
    std::fill_n(&scratch.base[0][0][0], TILE_PIXELS * SILHOUETTE, 0.0f);
    if (FEATURES) std::fill(scratch.features.begin(), scratch.features.end(), 0.0f);
    std::fill_n(ends, (int)BLOCKS, 0);
    uint32_t alive = ALL_BLOCKS;
    for (int start = 0; start < count && alive; start += BATCH) {
        const int n = std::min((int)BATCH, count - start);
        for (BlockList& list : scratch.lists) list.count = 0;
        for (int j = 0; j < n; ++j) {
            if (j + PREFETCHED < n) __builtin_prefetch(&state.splats[state.pair_splat[begin + start + j + PREFETCHED]]);
            prepare<SHAPE>(state, state.pair_splat[begin + start + j], (float)left, (float)top, scratch.entries[j]);
            for (uint32_t m = scratch.entries[j].blocks & alive; m; m &= m - 1) {
                BlockList& list = scratch.lists[__builtin_ctz(m)];
                list.entry[list.count++] = (uint8_t)j;
            }
        }
        for (uint32_t m = alive; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            const BlockList& list = scratch.lists[block];
            if (!list.count) continue;
            const int used = composite_block<SHAPE, FEATURES>(scratch, block, T + BLOCK_PIXELS * block);
            ends[block] = start + list.entry[used - 1] + 1;
            if (FEATURES) {
                add_all_features(scratch, list, used, map,
                                 scratch.features.data() + (size_t)block * map.extra_channels() * BLOCK_PIXELS);
            }
            if (is_dark(T + BLOCK_PIXELS * block)) alive &= ~(1u << block);
        }
    }
}

template <Shape SHAPE>
void composite_tiles(const Gaussians& map, const uint8_t* region, Rasterisation& state, float* images) {
    const int tiles = state.tiles(), S = map.extra_channels();
#pragma omp parallel
    {
        auto scratch = std::make_unique<ForwardScratch>();
        scratch->features.resize((size_t)S * TILE_PIXELS);
#pragma omp for schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            if (region && !region[tile]) continue;
            if (S) {
                composite_tile<SHAPE, true>(map, state, tile, *scratch);
            } else {
                composite_tile<SHAPE, false>(map, state, tile, *scratch);
            }
            write_tile(state, *scratch, tile, S, images);
        }
    }
}

}  // namespace

void composite(const Gaussians& map, const uint8_t* region, Rasterisation& state, float* images) {
    state.transmittance.resize((size_t)state.tiles() * TILE_PIXELS);
    state.block_end.resize((size_t)state.tiles() * BLOCKS);
    if (state.shape == Shape::SPHERE) {
        composite_tiles<Shape::SPHERE>(map, region, state, images);
    } else {
        composite_tiles<Shape::ELLIPSOID>(map, region, state, images);
    }
}

}  // namespace semsplat
