// Front-to-back compositing (H-19, H-20, G-1), one tile at a time, one 4x4 block at a time.
#include <algorithm>

#include "rendering/tile.hpp"

namespace semsplat {
namespace {

struct BlockList {
    int count = 0;
    uint8_t entry[BATCH];
};

struct ForwardScratch {
    TileEntry entries[BATCH];
    BlockList lists[BLOCKS];
    alignas(64) float base[BLOCKS][SILHOUETTE][16];  // red, green, blue, depth of each block
    alignas(64) float weights[BATCH][16];   // blending weights of one block for its feature channels
    uint8_t weighted[BATCH];                // entries of these weights
    std::vector<float> features;            // [BLOCKS, S, 16]
};

// Composites `N` feature channels of one block.
template <int N>
void add_features(const ForwardScratch& scratch, int count, const float* features, int channels,
                  int first, float* sums) {
    F16 acc[N];
    for (int c = 0; c < N; ++c) acc[c] = load(sums + 16 * (first + c));
    for (int k = 0; k < count; ++k) {
        const F16 w = load(scratch.weights[k]);
        const float* f = features + (size_t)scratch.entries[scratch.weighted[k]].id * channels + first;
        for (int c = 0; c < N; ++c) acc[c] = fma(w, all(f[c]), acc[c]);
    }
    for (int c = 0; c < N; ++c) store(sums + 16 * (first + c), acc[c]);
}

void add_all_features(const ForwardScratch& scratch, int count, const Gaussians& map, float* sums) {
    const int S = map.feature_channels;
    int c = 0;
    for (; c + WIDEST <= S; c += WIDEST) add_features<WIDEST>(scratch, count, map.features, S, c, sums);
    if (WIDEST > 8 && c + 8 <= S) add_features<8>(scratch, count, map.features, S, c, sums), c += 8;
    if (WIDEST > 4 && c + 4 <= S) add_features<4>(scratch, count, map.features, S, c, sums), c += 4;
    if (S - c == 3) add_features<3>(scratch, count, map.features, S, c, sums), c += 3;
    for (; c < S; ++c) add_features<1>(scratch, count, map.features, S, c, sums);
    if (map.centres) add_features<3>(scratch, count, map.means, 3, 0, sums + 16 * S);
}

// Composites one batch into one block. Returns the number of entries used; it is smaller than the
// length of the list if the block became opaque.
template <bool FEATURES>
int composite_block(ForwardScratch& scratch, int block, float* transmittance, int* weighted) {
    const BlockList& list = scratch.lists[block];
    F16 T = load(transmittance);
    float* const base = &scratch.base[block][0][0];
    F16 r = load(base), g = load(base + 16), b = load(base + 32), z = load(base + 48);
    const F16 cut = all(MIN_ALPHA), most = all(MAX_ALPHA), dark = all(MIN_TRANSMITTANCE);
    int n = 0, kept = 0;
    while (n < list.count) {
        const int index = list.entry[n++];
        const TileEntry& e = scratch.entries[index];
        const F16 raw = load_columns(columns_of(e, block)) * load_rows(rows_of(e, block));
        const F16 alpha = keep(ge(raw, cut), minimum(raw, most));
        const F16 w = alpha * T;
        T = fnma(alpha, T, T);  // a single rounding; T - w is inaccurate for alpha near 1
        r = fma(w, all(e.r), r);
        g = fma(w, all(e.g), g);
        b = fma(w, all(e.b), b);
        z = fma(w, all(e.z), z);
        if (FEATURES) {
            store(scratch.weights[kept], w);
            scratch.weighted[kept++] = (uint8_t)index;
        }
        if (!bits(ge(T, dark))) break;
    }
    store(transmittance, T);
    store(base, r);
    store(base + 16, g);
    store(base + 32, b);
    store(base + 48, z);
    *weighted = kept;
    return n;
}

void start_transmittance(const Pinhole& cam, int left, int top, float* transmittance) {
    for (int block = 0; block < BLOCKS; ++block) {
        for (int p = 0; p < 16; ++p) {
            const int x = left + 4 * (block & 3) + (p & 3), y = top + 4 * (block >> 2) + (p >> 2);
            transmittance[16 * block + p] = x < cam.width && y < cam.height ? 1.0f : 0.0f;
        }
    }
}

// Writes one channel of a tile from block order into image rows.
void write_channel(const Pinhole& cam, int left, int top, const float* blocks, size_t stride,
                   float* image) {
    for (int block = 0; block < BLOCKS; ++block) {
        const int x = left + 4 * (block & 3), y0 = top + 4 * (block >> 2);
        const int columns = std::min(4, cam.width - x);
        for (int row = 0; row < 4 && y0 + row < cam.height && columns > 0; ++row) {
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
        write_channel(cam, left, top, scratch.base[0][c], 64, images + c * plane);
    }
    alignas(64) float silhouette[TILE_PIXELS];
    const float* T = state.transmittance.data() + (size_t)tile * TILE_PIXELS;
    for (int p = 0; p < TILE_PIXELS; ++p) silhouette[p] = 1.0f - T[p];
    write_channel(cam, left, top, silhouette, 16, images + SILHOUETTE * plane);
    for (int c = 0; c < S; ++c) {
        write_channel(cam, left, top, scratch.features.data() + 16 * c, (size_t)16 * S,
                      images + (BASE_CHANNELS + c) * plane);
    }
}

template <bool FEATURES>
void composite_tile(const Gaussians& map, Rasterisation& state, int tile, ForwardScratch& scratch) {
    const int left = tile % state.tiles_x * TILE, top = tile / state.tiles_x * TILE;
    const int begin = state.tile_begin[tile], count = state.tile_begin[tile + 1] - begin;
    float* const T = state.transmittance.data() + (size_t)tile * TILE_PIXELS;
    int32_t* const ends = state.block_end.data() + (size_t)tile * BLOCKS;
    start_transmittance(state.camera, left, top, T);
    std::fill_n(&scratch.base[0][0][0], BLOCKS * 64, 0.0f);
    if (FEATURES) std::fill(scratch.features.begin(), scratch.features.end(), 0.0f);
    std::fill_n(ends, (int)BLOCKS, 0);
    uint32_t alive = 0xffff;
    for (int start = 0; start < count && alive; start += BATCH) {
        const int n = std::min((int)BATCH, count - start);
        for (BlockList& list : scratch.lists) list.count = 0;
        for (int j = 0; j < n; ++j) {
            if (j + 4 < n) __builtin_prefetch(&state.splats[state.pair_splat[begin + start + j + 4]]);
            prepare(state.splats[state.pair_splat[begin + start + j]], (float)left, (float)top,
                    scratch.entries[j]);
            for (uint32_t m = scratch.entries[j].blocks & alive; m; m &= m - 1) {
                BlockList& list = scratch.lists[__builtin_ctz(m)];
                list.entry[list.count++] = (uint8_t)j;
            }
        }
        for (uint32_t m = alive; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            const BlockList& list = scratch.lists[block];
            if (!list.count) continue;
            int weighted;
            const int used = composite_block<FEATURES>(scratch, block, T + 16 * block, &weighted);
            ends[block] = start + list.entry[used - 1] + 1;
            if (FEATURES) {
                add_all_features(scratch, weighted, map,
                                 scratch.features.data() + (size_t)block * map.extra_channels() * 16);
            }
            if (!bits(ge(load(T + 16 * block), all(MIN_TRANSMITTANCE)))) alive &= ~(1u << block);
        }
    }
}

}  // namespace

void composite(const Gaussians& map, const uint8_t* region, Rasterisation& state, float* images) {
    const int tiles = state.tiles(), S = map.extra_channels();
    state.transmittance.resize((size_t)tiles * TILE_PIXELS);
    state.block_end.resize((size_t)tiles * BLOCKS);
#pragma omp parallel
    {
        auto scratch = std::make_unique<ForwardScratch>();
        scratch->features.resize((size_t)S * TILE_PIXELS);
#pragma omp for schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            if (region && !region[tile]) continue;
            if (S) {
                composite_tile<true>(map, state, tile, *scratch);
            } else {
                composite_tile<false>(map, state, tile, *scratch);
            }
            write_tile(state, *scratch, tile, S, images);
        }
    }
}

}  // namespace semsplat
