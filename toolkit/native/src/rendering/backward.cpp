// Gradients of the compositing, back to front, in one pass over the tiles.
//
// With w_k = alpha_k T_k and d = dL/d(pixel), dL/dalpha_k = T_k <f_k, d> - S_k / (1 - alpha_k),
// where S_k sums w_j <f_j, d> over all j behind k, and is initialised by the silhouette's gradient.
// Every (splat, tile) pair has its own memory for its sums. There are no data races, and the sums of a
// splat are added in the order of its tiles for any number of threads.
#include <algorithm>
#include <cstring>

#include "rendering/tile.hpp"

namespace semsplat {
namespace {

enum { SUMS = 8, POSE_CHUNK = 4096 };
// Sums of one pair: e = alpha dL/dalpha, its moments, and the base channels' gradients.
enum { E, E_DX, E_DY, E_SQUARE, GRAD_Z, GRAD_R, GRAD_G, GRAD_B };

// Propagation of the feature channels' gradients: none, to the features, or to all parameters.
enum class Features { NONE, ALONE, MOVE };

struct BackwardScratch {
    TileEntry entries[BATCH];
    alignas(64) float T[BLOCKS][16], behind[BLOCKS][16];
    alignas(64) float d[SILHOUETTE][BLOCKS][16];        // dL/d red, green, blue, depth
    std::vector<float> d_features;             // [S, BLOCKS, 16]
    alignas(64) float weight[BLOCKS][16], dot[BLOCKS][16];
};

// Alpha of an entry on a block, and the mask where it is differentiable (neither cut nor clamped).
struct Alpha {
    F16 value;
    M16 free;
};
SEMSPLAT_INLINE Alpha alpha_of(const TileEntry& e, int block) {
    const F16 raw = load_columns(columns_of(e, block)) * load_rows(rows_of(e, block));
    const M16 seen = ge(raw, all(MIN_ALPHA));
    return {keep(seen, minimum(raw, all(MAX_ALPHA))), both(seen, lt(raw, all(MAX_ALPHA)))};
}

void read_channel(const Pinhole& cam, int left, int top, const float* image, float* blocks) {
    for (int block = 0; block < BLOCKS; ++block) {
        const int x = left + 4 * (block & 3), y0 = top + 4 * (block >> 2);
        const int columns = std::min(4, cam.width - x);
        for (int row = 0; row < 4; ++row) {
            float* to = blocks + 16 * block + 4 * row;
            for (int k = 0; k < 4; ++k) {
                to[k] = k < columns && y0 + row < cam.height
                            ? image[(size_t)(y0 + row) * cam.width + x + k]
                            : 0.0f;
            }
        }
    }
}

void load_tile(const Rasterisation& state, int tile, int S, const float* d_images, BackwardScratch& scratch) {
    const Pinhole& cam = state.camera;
    const size_t plane = (size_t)cam.width * cam.height;
    const int left = tile % state.tiles_x * TILE, top = tile / state.tiles_x * TILE;
    for (int c = 0; c < SILHOUETTE; ++c) read_channel(cam, left, top, d_images + c * plane, scratch.d[c][0]);
    read_channel(cam, left, top, d_images + SILHOUETTE * plane, scratch.behind[0]);
    const float* T = state.transmittance.data() + (size_t)tile * TILE_PIXELS;
    std::memcpy(scratch.T, T, sizeof scratch.T);
    for (int block = 0; block < BLOCKS; ++block) {
        for (int p = 0; p < 16; ++p) scratch.behind[block][p] *= -T[16 * block + p];
    }
    for (int c = 0; c < S; ++c) {
        read_channel(cam, left, top, d_images + (BASE_CHANNELS + c) * plane,
                     scratch.d_features.data() + (size_t)c * TILE_PIXELS);
    }
}

// dL/df of N feature channels; if they are propagated to all parameters, adds <f, d> to each block's
// dot product.
template <int N, bool MOVE>
SEMSPLAT_INLINE void feature_step(BackwardScratch& scratch, uint32_t blocks, const float* f, int first,
                                  float* gradient) {
    F16 acc[N];
    for (int c = 0; c < N; ++c) acc[c] = all(0.0f);
    for (uint32_t m = blocks; m; m &= m - 1) {
        const int block = __builtin_ctz(m);
        const F16 w = load(scratch.weight[block]);
        F16 dot = MOVE ? load(scratch.dot[block]) : all(0.0f);
        const float* d = scratch.d_features.data() + ((size_t)first * BLOCKS + block) * 16;
        for (int c = 0; c < N; ++c) {
            const F16 dc = load(d + (size_t)c * TILE_PIXELS);
            if (MOVE) dot = fma(dc, all(f[first + c]), dot);
            acc[c] = fma(w, dc, acc[c]);
        }
        if (MOVE) store(scratch.dot[block], dot);
    }
    if (N == 16) {
        sum16(acc, gradient + first);
    } else {
        F16 padded[8];
        float sums[8];
        for (int c = 0; c < 8; ++c) padded[c] = c < N ? acc[c < N ? c : 0] : all(0.0f);
        sum8(padded, sums);
        for (int c = 0; c < N; ++c) gradient[first + c] = sums[c];
    }
}

template <bool MOVE>
void feature_steps(BackwardScratch& scratch, uint32_t blocks, const float* f, int S, float* gradient) {
    int c = 0;
    for (; c + WIDEST <= S; c += WIDEST) feature_step<WIDEST, MOVE>(scratch, blocks, f, c, gradient);
    if (WIDEST > 8 && c + 8 <= S) feature_step<8, MOVE>(scratch, blocks, f, c, gradient), c += 8;
    if (WIDEST > 4 && c + 4 <= S) feature_step<4, MOVE>(scratch, blocks, f, c, gradient), c += 4;
    for (; c < S; ++c) feature_step<1, MOVE>(scratch, blocks, f, c, gradient);
}

// Processes all blocks of one pair: back-to-front state in `scratch`, sums in `out` (SUMS floats).
template <bool COLOUR, Features FEATURES>
SEMSPLAT_INLINE void differentiate_pair(BackwardScratch& scratch, const TileEntry& e, uint32_t blocks,
                                        const float* f, int S, float* out, float* d_features) {
    F16 acc[SUMS];
    for (F16& a : acc) a = all(0.0f);
    if (FEATURES != Features::NONE) {
        for (uint32_t m = blocks; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            const Alpha a = alpha_of(e, block);
            const F16 T = load(scratch.T[block]) * reciprocal(all(1.0f) - a.value);
            store(scratch.weight[block], a.value * T);
            if (FEATURES == Features::MOVE) store(scratch.dot[block], all(0.0f));
        }
        feature_steps<FEATURES == Features::MOVE>(scratch, blocks, f, S, d_features);
    }
    for (uint32_t m = blocks; m; m &= m - 1) {
        const int block = __builtin_ctz(m);
        const Alpha a = alpha_of(e, block);
        const F16 inverse = reciprocal(all(1.0f) - a.value);
        const F16 T = load(scratch.T[block]) * inverse;
        const F16 w = a.value * T;
        const F16 dr = load(scratch.d[0][block]), dg = load(scratch.d[1][block]);
        const F16 db = load(scratch.d[2][block]), dz = load(scratch.d[3][block]);
        F16 dot = FEATURES == Features::MOVE ? load(scratch.dot[block]) : all(0.0f);
        dot = fma(dr, all(e.r), fma(dg, all(e.g), fma(db, all(e.b), fma(dz, all(e.z), dot))));
        const F16 behind = load(scratch.behind[block]);
        const F16 grad = keep(a.free, fnma(behind, inverse, T * dot) * a.value);
        store(scratch.behind[block], fma(w, dot, behind));
        store(scratch.T[block], T);
        const F16 dx = load_columns(COUNTING + 4 * (block & 3)) - all(e.u);
        const F16 dy = load_rows(COUNTING + 4 * (block >> 2)) - all(e.v);
        const F16 gx = grad * dx, gy = grad * dy;
        acc[E] = acc[E] + grad;
        acc[E_DX] = acc[E_DX] + gx;
        acc[E_DY] = acc[E_DY] + gy;
        acc[E_SQUARE] = fma(gx, dx, fma(gy, dy, acc[E_SQUARE]));
        acc[GRAD_Z] = fma(w, dz, acc[GRAD_Z]);
        if (COLOUR) {
            acc[GRAD_R] = fma(w, dr, acc[GRAD_R]);
            acc[GRAD_G] = fma(w, dg, acc[GRAD_G]);
            acc[GRAD_B] = fma(w, db, acc[GRAD_B]);
        }
    }
    sum8(acc, out);
}

// Storage of the sums of pairs: a splat on a single tile has one row, others have a row per tile.
struct PairSums {
    Buffer<float> own, shared;                    // [V, SUMS], [slots, SUMS]
    Buffer<float> shared_features;                // [slots, S]
    float* row(int splat, int slot) {
        return slot < 0 ? own.data() + (size_t)splat * SUMS : shared.data() + (size_t)slot * SUMS;
    }
    float* feature_row(float* direct, int splat, int slot, int S) {
        return slot < 0 ? direct + (size_t)splat * S : shared_features.data() + (size_t)slot * S;
    }
};

template <bool COLOUR, Features FEATURES>
void differentiate_tile(const Gaussians& map, const Rasterisation& state, int tile, BackwardScratch& scratch,
                        PairSums& sums, float* d_features) {
    const int left = tile % state.tiles_x * TILE, top = tile / state.tiles_x * TILE;
    const int begin = state.tile_begin[tile], count = state.tile_begin[tile + 1] - begin;
    const int32_t* ends = state.block_end.data() + (size_t)tile * BLOCKS;
    const int S = map.feature_channels;
    const int last = *std::max_element(ends, ends + BLOCKS);
    // Rows of pairs that were not composited must be zero.
    for (int k = last; k < count; ++k) {
        const int splat = state.pair_splat[begin + k], slot = state.pair_slot[begin + k];
        std::fill_n(sums.row(splat, slot), (int)SUMS, 0.0f);
        if (FEATURES != Features::NONE) std::fill_n(sums.feature_row(d_features, splat, slot, S), S, 0.0f);
    }
    uint32_t open = 0;  // mask of blocks whose last pair was reached
    for (int end = last; end > 0;) {
        const int start = (end - 1) / BATCH * BATCH;
        for (int j = 0; j < end - start; ++j) {
            if (j + 4 < end - start) __builtin_prefetch(&state.splats[state.pair_splat[begin + start + j + 4]]);
            const int splat = state.pair_splat[begin + start + j];
            prepare(state.splats[splat], (float)left, (float)top, scratch.entries[j]);
            scratch.entries[j].splat = splat;
            scratch.entries[j].slot = state.pair_slot[begin + start + j];
        }
        for (int k = end - 1; k >= start; --k) {
            for (uint32_t m = ~open & 0xffff; m; m &= m - 1) {
                const int block = __builtin_ctz(m);
                if (k < ends[block]) open |= 1u << block;
            }
            const TileEntry& e = scratch.entries[k - start];
            float* fg = FEATURES != Features::NONE ? sums.feature_row(d_features, e.splat, e.slot, S) : nullptr;
            differentiate_pair<COLOUR, FEATURES>(scratch, e, e.blocks & open,
                                                 fg ? map.features + (size_t)e.id * S : nullptr, S,
                                                 sums.row(e.splat, e.slot), fg);
        }
        end = start;
    }
}

// Chain rule from the sums of one splat to its parameters; adds its contribution to the pose.
void finish_splat(const Gaussians& map, const Rasterisation& state, int64_t i, const float* s,
                  const GradientSinks& out, double* pose) {
    const Splat& p = state.splats[i];
    const Pinhole& cam = state.camera;
    const float inverse_z = 1.0f / p.z, inverse_variance = -2.0f * p.exponent;
    const float gu = s[E_DX] * inverse_variance, gv = s[E_DY] * inverse_variance;
    const float g_log_sigma = s[E_SQUARE] * inverse_variance;
    const float x = (p.u - cam.cx) / cam.fx, y = (p.v - cam.cy) / cam.fy;  // X / Z, Y / Z
    const float g[3] = {gu * cam.fx * inverse_z, gv * cam.fy * inverse_z,
                        s[GRAD_Z] - (gu * cam.fx * x + gv * cam.fy * y + g_log_sigma) * inverse_z};
    for (int k = 0; k < 3; ++k) {
        out.means[3 * i + k] = state.R[k] * g[0] + state.R[3 + k] * g[1] + state.R[6 + k] * g[2];
    }
    out.log_radii[i] = g_log_sigma;
    out.opacity_logits[i] = s[E] * (1.0f - p.opacity);
    if (out.colours) std::copy_n(s + GRAD_R, 3, out.colours + 3 * i);
    const float* m = map.means + 3 * (size_t)p.id;
    for (int row = 0; row < 3; ++row) {
        for (int k = 0; k < 3; ++k) pose[4 * row + k] += (double)g[row] * m[k];
        pose[4 * row + 3] += g[row];
    }
}

void finish(const Gaussians& map, const Rasterisation& state, const PairSums& sums, const GradientSinks& out) {
    const int64_t visible = (int64_t)state.splats.size();
    const int64_t chunks = (visible + POSE_CHUNK - 1) / POSE_CHUNK;
    const int S = map.feature_channels;
    std::vector<double> poses((size_t)chunks * 12, 0.0);
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; ++c) {
        for (int64_t i = c * POSE_CHUNK; i < std::min(visible, (c + 1) * POSE_CHUNK); ++i) {
            const Splat& p = state.splats[i];
            float total[SUMS] = {0};
            if (p.pairs == 1) {
                std::copy_n(sums.own.data() + (size_t)i * SUMS, (int)SUMS, total);
            } else {
                std::fill_n(out.features + (size_t)i * S, S, 0.0f);
            }
            for (int k = 0; k < p.pairs && p.slot >= 0; ++k) {
                const float* row = sums.shared.data() + (size_t)(p.slot + k) * SUMS;
                for (int q = 0; q < SUMS; ++q) total[q] += row[q];
                const float* f = sums.shared_features.data() + (size_t)(p.slot + k) * S;
                for (int q = 0; q < S; ++q) out.features[(size_t)i * S + q] += f[q];
            }
            finish_splat(map, state, i, total, out, poses.data() + 12 * c);
        }
    }
    std::fill_n(out.T_camera_map, 12, 0.0);
    for (int64_t c = 0; c < chunks; ++c) {
        for (int k = 0; k < 12; ++k) out.T_camera_map[k] += poses[(size_t)c * 12 + k];
    }
}

template <bool COLOUR, Features FEATURES>
void differentiate_tiles(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                         const float* d_images, PairSums& sums, float* d_features) {
    const int tiles = state.tiles(), S = FEATURES != Features::NONE ? map.feature_channels : 0;
#pragma omp parallel
    {
        auto scratch = std::make_unique<BackwardScratch>();
        scratch->d_features.resize((size_t)S * TILE_PIXELS);
#pragma omp for schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            if ((region && !region[tile]) || state.tile_begin[tile] == state.tile_begin[tile + 1]) continue;
            load_tile(state, tile, S, d_images, *scratch);
            differentiate_tile<COLOUR, FEATURES>(map, state, tile, *scratch, sums, d_features);
        }
    }
}

template <Features FEATURES>
void differentiate_tiles_of(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                            const float* d_images, PairSums& sums, const GradientSinks& out) {
    const auto run = out.colours ? differentiate_tiles<true, FEATURES> : differentiate_tiles<false, FEATURES>;
    run(map, region, state, d_images, sums, out.features);
}

}  // namespace

void differentiate(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                   const float* d_images, bool detached, const GradientSinks& out) {
    // Reused by later calls: allocating pages takes longer than computing the sums.
    static thread_local PairSums sums;
    sums.own.resize(state.splats.size() * SUMS);
    sums.shared.resize((size_t)state.slots * SUMS);
    sums.shared_features.resize((size_t)state.slots * map.feature_channels);
    if (!map.feature_channels) {
        differentiate_tiles_of<Features::NONE>(map, region, state, d_images, sums, out);
    } else if (detached) {
        differentiate_tiles_of<Features::ALONE>(map, region, state, d_images, sums, out);
    } else {
        differentiate_tiles_of<Features::MOVE>(map, region, state, d_images, sums, out);
    }
    finish(map, state, sums, out);
}

}  // namespace semsplat
