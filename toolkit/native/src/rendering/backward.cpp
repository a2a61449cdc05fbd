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

// Maximum number of feature channels whose sums over a pair's blocks fit into the registers.
enum { MAX_DIFFERENTIATED = LANES == 16 ? 16 : 8 };
// Up to this number of feature channels, their gradients are computed together with the others if the
// target has enough registers.
enum { FEW = 4 };
constexpr bool CAN_FUSE = LANES == 16;
// Whether loading alpha and its derived values again is faster than computing them again.
constexpr bool KEEP_ALPHA = LANES < 16;
enum { SUMS = 8, POSE_CHUNK = 4096 };
// Sums of one pair: e = alpha dL/dalpha, its moments, and the base channels' gradients.
enum { E, E_DX, E_DY, E_SQUARE, GRAD_Z, GRAD_R, GRAD_G, GRAD_B };

// Propagation of the feature channels' gradients: none, to the features, or to all parameters.
enum class Features { NONE, ALONE, MOVE };

struct BackwardScratch {
    TileEntry entries[BATCH];
    alignas(64) float T[BLOCKS][BLOCK_PIXELS], behind[BLOCKS][BLOCK_PIXELS];
    alignas(64) float d[SILHOUETTE][BLOCKS][BLOCK_PIXELS];  // dL/d red, green, blue, depth
    std::vector<float> d_features;                          // [S, BLOCKS, BLOCK_PIXELS]
    // Of the current pair, stored by the pass over its features.
    alignas(64) float alpha[BLOCKS][BLOCK_PIXELS], inverse[BLOCKS][BLOCK_PIXELS];
    alignas(64) float weight[BLOCKS][BLOCK_PIXELS], dot[BLOCKS][BLOCK_PIXELS];
};

// Alpha of an entry at the pixels of one part of a block: zero below MIN_ALPHA, at most MAX_ALPHA.
SEMSPLAT_INLINE Floats alpha_of(const TileEntry& e, int block, int part) {
    const Floats raw = gaussian_of(e, block, part);
    return keep(ge(raw, all(MIN_ALPHA)), minimum(raw, all(MAX_ALPHA)));
}

void read_channel(const Pinhole& cam, int left, int top, const float* image, float* blocks) {
    for (int block = 0; block < BLOCKS; ++block) {
        const int x = left + block_column(block), y0 = top + block_row(block);
        const int columns = std::min(4, cam.width - x);
        for (int row = 0; row < BLOCK_ROWS; ++row) {
            float* to = blocks + BLOCK_PIXELS * block + 4 * row;
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
        for (int p = 0; p < BLOCK_PIXELS; ++p) scratch.behind[block][p] *= -T[BLOCK_PIXELS * block + p];
    }
    for (int c = 0; c < S; ++c) {
        read_channel(cam, left, top, d_images + (BASE_CHANNELS + c) * plane,
                     scratch.d_features.data() + (size_t)c * TILE_PIXELS);
    }
}

// dL/df of N feature channels over one or more blocks; if they are propagated to all parameters, adds
// <f, d> to each block's dot product.
template <int N, bool MOVE>
SEMSPLAT_INLINE void feature_step(BackwardScratch& scratch, uint32_t blocks, const float* f, int first,
                                  float* gradient) {
    const float* values = f + first;
    const float* const d_first = scratch.d_features.data() + (size_t)first * TILE_PIXELS;
    Floats acc[N];
    for (int c = 0; c < N; ++c) acc[c] = all(0.0f);
    uint32_t m = blocks;
    do {
        const int block = __builtin_ctz(m);
        // Otherwise GCC keeps the addresses of all values in registers.
        asm("" : "+r"(values));
        const float* const d = d_first + (size_t)block * BLOCK_PIXELS;
        for (int p = 0; p < PARTS; ++p) {
            const int at = LANES * p;
            const Floats w = load(scratch.weight[block] + at);
            // Two sums, since each addition waits for the previous one.
            Floats even = MOVE ? load(scratch.dot[block] + at) : all(0.0f), odd = all(0.0f);
            for (int c = 0; c < N; ++c) {
                const Floats dc = load(d + (size_t)c * TILE_PIXELS + at);
                if (MOVE && c % 2 == 0) even = fma(dc, all(values[c]), even);
                if (MOVE && c % 2 == 1) odd = fma(dc, all(values[c]), odd);
                acc[c] = fma(w, dc, acc[c]);
            }
            if (MOVE) store(scratch.dot[block] + at, even + odd);
        }
    } while (m &= m - 1);
    sum_lanes(acc, gradient + first);
}

template <bool MOVE>
void feature_steps(BackwardScratch& scratch, uint32_t blocks, const float* f, int S, float* gradient) {
    for_channel_groups<MAX_DIFFERENTIATED>(S, [&](auto n, int first) {
        feature_step<decltype(n)::value, MOVE>(scratch, blocks, f, first, gradient);
    });
}

// Processes all blocks of one pair: back-to-front state in `scratch`, sums in `out` (SUMS floats).
template <bool COLOUR, Features FEATURES, bool FUSED>
SEMSPLAT_INLINE void differentiate_pair(BackwardScratch& scratch, const TileEntry& e, uint32_t blocks,
                                        const float* f, int S, float* out, float* d_features) {
    if (!blocks) {
        std::fill_n(out, (int)SUMS, 0.0f);
        if (FEATURES != Features::NONE) std::fill_n(d_features, S, 0.0f);
        return;
    }
    constexpr bool MOVE = FEATURES == Features::MOVE, SEPARATE = FEATURES != Features::NONE && !FUSED;
    if (SEPARATE) {
        for (uint32_t m = blocks; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            for (int part = 0; part < PARTS; ++part) {
                const int at = LANES * part;
                const Floats alpha = alpha_of(e, block, part), inverse = reciprocal(all(1.0f) - alpha);
                if (KEEP_ALPHA) {
                    store(scratch.alpha[block] + at, alpha);
                    store(scratch.inverse[block] + at, inverse);
                }
                store(scratch.weight[block] + at, alpha * (load(scratch.T[block] + at) * inverse));
                if (MOVE) store(scratch.dot[block] + at, all(0.0f));
            }
        }
        feature_steps<MOVE>(scratch, blocks, f, S, d_features);
    }
    constexpr int FUSED_CHANNELS = FUSED ? FEW : 0;
    float values[FEW] = {0};
    if (FUSED) std::copy_n(f, S, values);
    Floats acc[SUMS], by_feature[FEW];
    for (Floats& a : acc) a = all(0.0f);
    for (int c = 0; c < FUSED_CHANNELS; ++c) by_feature[c] = all(0.0f);
    for (uint32_t m = blocks; m; m &= m - 1) {
        const int block = __builtin_ctz(m);
        Floats column_sums = all(0.0f);  // of gradients with the same dx
        for (int part = 0; part < PARTS; ++part) {
            const int at = LANES * part;
            float *const T_at = scratch.T[block] + at, *const behind_at = scratch.behind[block] + at;
            Floats alpha, inverse;
            if (!KEEP_ALPHA || !SEPARATE) {
                alpha = alpha_of(e, block, part);
                inverse = reciprocal(all(1.0f) - alpha);
            } else {
                alpha = load(scratch.alpha[block] + at);
                inverse = load(scratch.inverse[block] + at);
            }
            const Floats T = load(T_at) * inverse, w = alpha * T;
            const Floats dr = load(scratch.d[0][block] + at), dg = load(scratch.d[1][block] + at);
            const Floats db = load(scratch.d[2][block] + at), dz = load(scratch.d[3][block] + at);
            Floats dot = MOVE && SEPARATE ? load(scratch.dot[block] + at) : all(0.0f);
            for (int c = 0; c < FUSED_CHANNELS; ++c) {
                const Floats dc = load(scratch.d_features.data() + c * TILE_PIXELS + block * BLOCK_PIXELS + at);
                if (MOVE) dot = fma(dc, all(values[c]), dot);
                by_feature[c] = fma(w, dc, by_feature[c]);
            }
            dot = fma(dr, all(e.r), fma(dg, all(e.g), fma(db, all(e.b), fma(dz, all(e.z), dot))));
            const Floats behind = load(behind_at);
            // Alpha is differentiable where it is neither cut, where it is zero, nor clamped.
            const Floats grad = keep(lt(alpha, all(MAX_ALPHA)), fnma(behind, inverse, T * dot) * alpha);
            store(behind_at, fma(w, dot, behind));
            store(T_at, T);
            const Floats dy = load_rows(COUNTING + block_row(block) + LANES / 4 * part) - all(e.v);
            const Floats gy = grad * dy;
            column_sums = column_sums + grad;
            acc[E_DY] = acc[E_DY] + gy;
            acc[E_SQUARE] = fma(gy, dy, acc[E_SQUARE]);
            acc[GRAD_Z] = fma(w, dz, acc[GRAD_Z]);
            if (COLOUR) {
                acc[GRAD_R] = fma(w, dr, acc[GRAD_R]);
                acc[GRAD_G] = fma(w, dg, acc[GRAD_G]);
                acc[GRAD_B] = fma(w, db, acc[GRAD_B]);
            }
        }
        const Floats dx = load_columns(COUNTING + block_column(block)) - all(e.u), gx = column_sums * dx;
        acc[E] = acc[E] + column_sums;
        acc[E_DX] = acc[E_DX] + gx;
        acc[E_SQUARE] = fma(gx, dx, acc[E_SQUARE]);
    }
    sum8(acc, out);
    if (FUSED) {
        float sums[FEW];
        sum_lanes(by_feature, sums);
        std::copy_n(sums, S, d_features);
    }
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

template <bool COLOUR, Features FEATURES, bool FUSED>
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
            for (uint32_t m = ~open & ALL_BLOCKS; m; m &= m - 1) {
                const int block = __builtin_ctz(m);
                if (k < ends[block]) open |= 1u << block;
            }
            const TileEntry& e = scratch.entries[k - start];
            float* fg = FEATURES != Features::NONE ? sums.feature_row(d_features, e.splat, e.slot, S) : nullptr;
            differentiate_pair<COLOUR, FEATURES, FUSED>(scratch, e, e.blocks & open,
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

template <bool COLOUR, Features FEATURES, bool FUSED>
void differentiate_tiles(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                         const float* d_images, PairSums& sums, float* d_features) {
    const int tiles = state.tiles(), S = FEATURES != Features::NONE ? map.feature_channels : 0;
#pragma omp parallel
    {
        auto scratch = std::make_unique<BackwardScratch>();
        scratch->d_features.resize((size_t)(FUSED ? (int)FEW : S) * TILE_PIXELS);
#pragma omp for schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            if ((region && !region[tile]) || state.tile_begin[tile] == state.tile_begin[tile + 1]) continue;
            load_tile(state, tile, S, d_images, *scratch);
            differentiate_tile<COLOUR, FEATURES, FUSED>(map, state, tile, *scratch, sums, d_features);
        }
    }
}

template <Features FEATURES>
void differentiate_tiles_of(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                            const float* d_images, PairSums& sums, const GradientSinks& out) {
    constexpr bool FUSED = CAN_FUSE && FEATURES != Features::NONE;
    auto run = out.colours ? differentiate_tiles<true, FEATURES, false> : differentiate_tiles<false, FEATURES, false>;
    if (FUSED && map.feature_channels <= FEW) {
        run = out.colours ? differentiate_tiles<true, FEATURES, FUSED> : differentiate_tiles<false, FEATURES, FUSED>;
    }
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
