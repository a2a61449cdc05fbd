// Gradients of the compositing, back to front, in one pass over the tiles.
//
// With w_k = alpha_k T_k and d = dL/d(pixel), dL/dalpha_k = T_k <f_k, d> - S_k / (1 - alpha_k),
// where S_k sums w_j <f_j, d> over all j behind k, and is initialised by the silhouette's gradient.
// Every (splat, tile) pair has its own memory for its sums. There are no data races, and the sums of a
// splat are added in the order of its tiles for any number of threads.
#include <algorithm>
#include <cstring>

#include "rendering/ellipsoids.hpp"
#include "rendering/tile.hpp"

namespace semsplat {
namespace {

// Channels are processed in groups of four: red, green, blue and depth first, then the features, padded
// by zeros. In memory, vector k of a group has the four channels of pixel 4 j + k in lanes 4 j to
// 4 j + 3. For dL/df, the lanes of a group's sum then need only LANES / 4 additions. Dot products of
// many feature groups use the same values, and add four lanes at the end; those of the first group,
// and of a single group of features, read the channels one by one.
enum { GROUP = 4, PLANAR = 2 * GROUP };
// Up to this number of groups, all is done in one pass over a pair's blocks, if the sums fit into the
// registers; otherwise the features have passes of their own.
enum { MAX_FUSED = LANES == 16 ? 8 : 2, MAX_SWEPT = LANES == 16 ? 12 : 7 };
// Whether loading alpha and its derived values again is faster than computing them again.
constexpr bool KEEP_ALPHA = LANES < 16;
enum { POSE_CHUNK = 4096 };

// Propagation of the feature channels' gradients: none, to the features, or to all parameters.
enum class Features { NONE, ALONE, MOVE };

struct BackwardScratch {
    TileEntry entries[BATCH];
    alignas(64) float T[BLOCKS][BLOCK_PIXELS], behind[BLOCKS][BLOCK_PIXELS];
    Buffer<float> d;  // dL/d channel [BLOCKS, PARTS, groups, GROUP, LANES]
    alignas(64) float planar[PLANAR][BLOCKS][BLOCK_PIXELS];  // that of the first channels
    int groups;
    std::vector<float> values;  // of the current pair's splat [groups, GROUP]
    // Of the current pair, if its features have passes of their own.
    alignas(64) float alpha[BLOCKS][BLOCK_PIXELS], inverse[BLOCKS][BLOCK_PIXELS];
    alignas(64) float weight[BLOCKS][BLOCK_PIXELS], dot[BLOCKS][BLOCK_PIXELS];

    // Of one part of a block, beginning with one group.
    const float* group(int block, int part, int first) const {
        return d.data() + ((size_t)(block * PARTS + part) * groups + first) * GROUP * LANES;
    }
};

SEMSPLAT_INLINE int groups_of(int features) { return 1 + (features + GROUP - 1) / GROUP; }

// Alpha of an entry at the pixels of one part of a block: zero below MIN_ALPHA, at most MAX_ALPHA.
template <Shape SHAPE>
SEMSPLAT_INLINE Floats alpha_of(const TileEntry& e, int block, int part) {
    Floats depth;
    const Floats raw = gaussian_of<SHAPE>(e, block, part, depth);
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
    read_channel(cam, left, top, d_images + SILHOUETTE * plane, scratch.behind[0]);
    const float* T = state.transmittance.data() + (size_t)tile * TILE_PIXELS;
    std::memcpy(scratch.T, T, sizeof scratch.T);
    for (int block = 0; block < BLOCKS; ++block) {
        for (int p = 0; p < BLOCK_PIXELS; ++p) scratch.behind[block][p] *= -T[BLOCK_PIXELS * block + p];
    }
    alignas(64) float channels[GROUP][TILE_PIXELS];
    for (int g = 0; g < scratch.groups; ++g) {
        for (int i = 0; i < GROUP; ++i) {
            const int feature = GROUP * (g - 1) + i, channel = g ? BASE_CHANNELS + feature : i;
            if (feature < S) {
                read_channel(cam, left, top, d_images + channel * plane, channels[i]);
            } else {
                std::fill_n(channels[i], (int)TILE_PIXELS, 0.0f);
            }
        }
        if (GROUP * g < PLANAR) std::memcpy(scratch.planar[GROUP * g], channels, sizeof channels);
        for (int at = 0; at < TILE_PIXELS; at += LANES) {
            Floats pixels[GROUP], mixed[GROUP];
            for (int i = 0; i < GROUP; ++i) pixels[i] = load(channels[i] + at);
            transpose_quads(pixels, mixed);
            float* to = scratch.d.data() + ((size_t)(at / LANES) * scratch.groups + g) * GROUP * LANES;
            for (int k = 0; k < GROUP; ++k) store(to + LANES * k, mixed[k]);
        }
    }
}

// The channels' values of one splat, padded to whole groups.
SEMSPLAT_INLINE void gather_values(const TileEntry& e, const float* f, int S, float* values) {
    std::copy_n(&e.r, (int)GROUP, values);
    int c = 0;
    for (; c + GROUP <= S; c += GROUP) std::copy_n(f + c, (int)GROUP, values + GROUP + c);
    if (c < S) {
        for (int i = 0; i < GROUP; ++i) values[GROUP + c + i] = c + i < S ? f[c + i] : 0.0f;
    }
}

// Stores the gradients of the features that begin with `first`, at most a group of them.
SEMSPLAT_INLINE void store_group(Floats sums, int first, int S, float* gradient) {
    float added[GROUP];
    sum_quads(sums, added);
    if (first + GROUP <= S) {
        std::copy_n(added, (int)GROUP, gradient + first);
    } else {
        for (int i = 0; first + i < S; ++i) gradient[first + i] = added[i];
    }
}

// For N groups at the pixels of one part of a block: adds w d to `sums`, and <f, d> of the first
// DOTS groups to `dot`. Each group has CHAINS sums, since each addition waits for the previous one.
template <int N, int DOTS, int CHAINS>
SEMSPLAT_INLINE void add_groups(const float* d, const float* values, Floats w, Floats* sums, Floats& dot) {
    Floats dots[GROUP];
    for_four([&](auto k) {
        const Floats wk = spread<k>(w);
        Floats even = all(0.0f), odd = all(0.0f);
        for (int g = 0; g < N; ++g) {
            const Floats dk = load(d + (GROUP * g + k) * LANES);
            if (g < DOTS && g % 2 == 0) even = fma(dk, load_columns(values + GROUP * g), even);
            if (g < DOTS && g % 2 == 1) odd = fma(dk, load_columns(values + GROUP * g), odd);
            Floats& sum = sums[CHAINS * g + k % CHAINS];
            sum = fma(wk, dk, sum);
        }
        dots[k] = DOTS > 1 ? even + odd : even;
    });
    if (DOTS) dot = dot + sums_of_quads(dots);
}

// The gradients of N groups of features over one or more blocks, and if they are propagated to all
// parameters, the features' share of the blocks' dot products.
template <int N, bool MOVE>
SEMSPLAT_INLINE void sweep_features(BackwardScratch& scratch, uint32_t blocks, int first, int S,
                                    float* gradient) {
    Floats sums[N];
    for (Floats& sum : sums) sum = all(0.0f);
    const float* const values = scratch.values.data() + GROUP * first;
    uint32_t m = blocks;
    do {
        const int block = __builtin_ctz(m);
        for (int part = 0; part < PARTS; ++part) {
            const int at = LANES * part;
            Floats dot = MOVE && first > 1 ? load(scratch.dot[block] + at) : all(0.0f);
            add_groups<N, MOVE ? N : 0, 1>(scratch.group(block, part, first), values,
                                           load(scratch.weight[block] + at), sums, dot);
            if (MOVE) store(scratch.dot[block] + at, dot);
        }
    } while (m &= m - 1);
    for (int g = 0; g < N; ++g) store_group(sums[g], GROUP * (first + g - 1), S, gradient);
}

template <bool MOVE>
void sweep_all_features(BackwardScratch& scratch, uint32_t blocks, int S, float* gradient) {
    int first = 1;
    for (; first + MAX_SWEPT <= scratch.groups; first += MAX_SWEPT) {
        sweep_features<MAX_SWEPT, MOVE>(scratch, blocks, first, S, gradient);
    }
    with_constant<1, MAX_SWEPT - 1>(scratch.groups - first, [&](auto n) {
        sweep_features<n, MOVE>(scratch, blocks, first, S, gradient);
    });
}

// Adds the moments of `grad` at the pixels of one part of a block, and those of the depth's gradient.
SEMSPLAT_INLINE void add_ellipsoid_moments(const TileEntry& e, int block, int part, Floats grad, Floats by_depth,
                                           Floats* moments, Floats* mixed) {
    Floats s, t;
    whitened(e, block, part, s, t);
    mixed[Z_S] = fma(by_depth, s, mixed[Z_S]);
    mixed[Z_T] = fma(by_depth, t, mixed[Z_T]);
    const Floats gs = grad * s, gt = grad * t;
    moments[E] = moments[E] + grad;
    moments[E_S] = moments[E_S] + gs;
    moments[E_T] = moments[E_T] + gt;
    moments[E_S_S] = fma(gs, s, moments[E_S_S]);
    mixed[E_S_T] = fma(gs, t, mixed[E_S_T]);
    mixed[E_T_T] = fma(gt, t, mixed[E_T_T]);
}

// Processes all blocks of one pair: back-to-front state in `scratch`, sums in `out` (see ellipsoids.hpp).
// FUSED is the number of groups done in one pass: all of them, or the first if the features have passes
// of their own.
template <Shape SHAPE, Features FEATURES, int FUSED>
SEMSPLAT_INLINE void differentiate_pair(BackwardScratch& scratch, const TileEntry& e, uint32_t blocks,
                                        const float* f, int S, float* out, float* d_features) {
    if (!blocks) {
        std::fill_n(out, sums_of(SHAPE), 0.0f);
        if (FEATURES != Features::NONE) std::fill_n(d_features, S, 0.0f);
        return;
    }
    constexpr bool SPHERE = SHAPE == Shape::SPHERE;
    constexpr bool MOVE = FEATURES == Features::MOVE, SEPARATE = FEATURES != Features::NONE && FUSED == 1;
    const float* values = &e.r;
    if (FEATURES != Features::NONE) {
        gather_values(e, f, S, scratch.values.data());
        values = scratch.values.data();
    }
    if (SEPARATE) {
        for (uint32_t m = blocks; m; m &= m - 1) {
            const int block = __builtin_ctz(m);
            for (int part = 0; part < PARTS; ++part) {
                const int at = LANES * part;
                const Floats alpha = alpha_of<SHAPE>(e, block, part), inverse = reciprocal(all(1.0f) - alpha);
                if (KEEP_ALPHA) {
                    store(scratch.alpha[block] + at, alpha);
                    store(scratch.inverse[block] + at, inverse);
                }
                store(scratch.weight[block] + at, alpha * (load(scratch.T[block] + at) * inverse));
            }
        }
        sweep_all_features<MOVE>(scratch, blocks, S, d_features);
    }
    // The operations on the first group do not depend on the features unless they move the Gaussians.
    constexpr bool FEW = FUSED <= 2;
    constexpr int OTHERS = FUSED - 1, CHAINS = FEW ? 2 : 1;
    Floats moments[GROUP], mixed[GROUP], first_sums[2], sums[OTHERS * CHAINS + 1];
    for (Floats& a : moments) a = all(0.0f);
    for (Floats& a : mixed) a = all(0.0f);
    for (Floats& a : first_sums) a = all(0.0f);
    for (Floats& a : sums) a = all(0.0f);
    for (uint32_t m = blocks; m; m &= m - 1) {
        const int block = __builtin_ctz(m);
        Floats column_sums = all(0.0f);  // of gradients with the same dx
        for (int part = 0; part < PARTS; ++part) {
            const int at = LANES * part;
            float *const T_at = scratch.T[block] + at, *const behind_at = scratch.behind[block] + at;
            Floats alpha, inverse;
            if (!KEEP_ALPHA || !SEPARATE) {
                alpha = alpha_of<SHAPE>(e, block, part);
                inverse = reciprocal(all(1.0f) - alpha);
            } else {
                alpha = load(scratch.alpha[block] + at);
                inverse = load(scratch.inverse[block] + at);
            }
            const Floats T = load(T_at) * inverse, w = alpha * T;
            Floats dot = MOVE && SEPARATE ? load(scratch.dot[block] + at) : all(0.0f);
            for (int c = 0; c < (MOVE && FEW ? GROUP * FUSED : (int)GROUP); ++c) {
                dot = fma(load(scratch.planar[c][block] + at), all(values[c]), dot);
            }
            if (!SPHERE) {  // the depth of the pixel instead of that of the centre
                Floats depth;
                gaussian_of<SHAPE>(e, block, part, depth);
                dot = fma(load(scratch.planar[GRAD_Z - GRAD_R][block] + at), depth - all(e.z), dot);
            }
            add_groups<1, 0, 2>(scratch.group(block, part, 0), values, w, first_sums, dot);
            add_groups<OTHERS, MOVE && !FEW ? OTHERS : 0, CHAINS>(scratch.group(block, part, 1), values + GROUP, w,
                                                                  sums, dot);
            const Floats behind = load(behind_at);
            // Alpha is differentiable where it is neither cut, where it is zero, nor clamped.
            const Floats grad = keep(lt(alpha, all(MAX_ALPHA)), fnma(behind, inverse, T * dot) * alpha);
            store(behind_at, fma(w, dot, behind));
            store(T_at, T);
            if (!SPHERE) {
                add_ellipsoid_moments(e, block, part, grad, w * load(scratch.planar[GRAD_Z - GRAD_R][block] + at), moments, mixed);
                continue;
            }
            const Floats dy = load_rows(COUNTING + block_row(block) + LANES / 4 * part) - all(e.v);
            const Floats gy = grad * dy;
            column_sums = column_sums + grad;
            moments[E_DY] = moments[E_DY] + gy;
            moments[E_SQUARE] = fma(gy, dy, moments[E_SQUARE]);
        }
        if (!SPHERE) continue;
        const Floats dx = load_columns(COUNTING + block_column(block)) - all(e.u), gx = column_sums * dx;
        moments[E] = moments[E] + column_sums;
        moments[E_DX] = moments[E_DX] + gx;
        moments[E_SQUARE] = fma(gx, dx, moments[E_SQUARE]);
    }
    sum_quads(sums_of_quads(moments), out + E);
    if (!SPHERE) sum_quads(sums_of_quads(mixed), out + MIXED);
    sum_quads(first_sums[0] + first_sums[1], out + GRAD_R);
    for (int g = 0; g < OTHERS; ++g) {
        store_group(CHAINS == 2 ? sums[2 * g] + sums[2 * g + 1] : sums[g], GROUP * g, S, d_features);
    }
}

// Storage of the sums of pairs: a splat on a single tile has one row, others have a row per tile.
struct PairSums {
    int count;                                    // sums per pair
    Buffer<float> own, shared;                    // [V, count], [slots, count]
    Buffer<float> shared_features;                // [slots, S]
    float* row(int splat, int slot) {
        return slot < 0 ? own.data() + (size_t)splat * count : shared.data() + (size_t)slot * count;
    }
    float* feature_row(float* direct, int splat, int slot, int S) {
        return slot < 0 ? direct + (size_t)splat * S : shared_features.data() + (size_t)slot * S;
    }
};

template <Shape SHAPE, Features FEATURES, int FUSED>
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
        std::fill_n(sums.row(splat, slot), sums_of(SHAPE), 0.0f);
        if (FEATURES != Features::NONE) std::fill_n(sums.feature_row(d_features, splat, slot, S), S, 0.0f);
    }
    uint32_t open = 0;  // mask of blocks whose last pair was reached
    for (int end = last; end > 0;) {
        const int start = (end - 1) / BATCH * BATCH;
        for (int j = 0; j < end - start; ++j) {
            if (j + PREFETCHED < end - start) __builtin_prefetch(&state.splats[state.pair_splat[begin + start + j + PREFETCHED]]);
            const int splat = state.pair_splat[begin + start + j];
            prepare<SHAPE>(state, splat, (float)left, (float)top, scratch.entries[j]);
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
            differentiate_pair<SHAPE, FEATURES, FUSED>(scratch, e, e.blocks & open,
                                                       fg ? map.features + (size_t)e.id * S : nullptr, S,
                                                       sums.row(e.splat, e.slot), fg);
        }
        end = start;
    }
}

// See ellipsoids.hpp.
void differentiate_sphere(const Gaussians& map, const Rasterisation& state, int64_t i, const float* s,
                          const GradientSinks& out, double* pose) {
    const Splat& p = state.splats[i];
    const Pinhole& cam = state.camera;
    const float inverse_z = 1.0f / p.z, inverse_variance = -2.0f * p.shape_a;
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

// The part of a filtered sphere's variance that is its own.
inline float own_part(const Rasterisation& state, int64_t i) {
    return 1.0f + 2.0f * state.low_pass.variance * state.splats[i].shape_a;
}

// Replaces the derivative by the filtered variance sigma^2 + v by that by sigma^2. A compensated opacity
// is scaled by the ratio of the two.
inline void unfilter(const Rasterisation& state, int64_t i, float* s) {
    const float part = own_part(state, i);
    s[E_SQUARE] *= part;
    if (state.low_pass.compensated) s[E_SQUARE] -= s[E] * (1.0f - part) / state.splats[i].shape_a;
}

template <Shape SHAPE>
void finish(const Gaussians& map, const Rasterisation& state, const PairSums& sums, const GradientSinks& out) {
    const int64_t visible = (int64_t)state.splats.size();
    const int64_t chunks = (visible + POSE_CHUNK - 1) / POSE_CHUNK;
    const int S = map.feature_channels;
    constexpr int COUNT = sums_of(SHAPE);
    std::vector<double> poses((size_t)chunks * 12, 0.0);
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; ++c) {
        for (int64_t i = c * POSE_CHUNK; i < std::min(visible, (c + 1) * POSE_CHUNK); ++i) {
            const Splat& p = state.splats[i];
            float total[COUNT] = {0};
            if (p.pairs == 1) {
                std::copy_n(sums.own.data() + (size_t)i * COUNT, COUNT, total);
            } else {
                std::fill_n(out.features + (size_t)i * S, S, 0.0f);
            }
            for (int k = 0; k < p.pairs && p.slot >= 0; ++k) {
                const float* row = sums.shared.data() + (size_t)(p.slot + k) * COUNT;
                for (int q = 0; q < COUNT; ++q) total[q] += row[q];
                const float* f = sums.shared_features.data() + (size_t)(p.slot + k) * S;
                for (int q = 0; q < S; ++q) out.features[(size_t)i * S + q] += f[q];
            }
            double* const pose = poses.data() + 12 * c;
            if (SHAPE == Shape::ELLIPSOID) {
                differentiate_ellipsoid(map, state, i, total, out, pose);
                continue;
            }
            if (state.low_pass.variance > 0) unfilter(state, i, total);
            differentiate_sphere(map, state, i, total, out, pose);
            if (state.low_pass.compensated) {
                out.opacity_logits[i] = total[E] * (1.0f - p.opacity / own_part(state, i));
            }
        }
    }
    std::fill_n(out.T_camera_map, 12, 0.0);
    for (int64_t c = 0; c < chunks; ++c) {
        for (int k = 0; k < 12; ++k) out.T_camera_map[k] += poses[(size_t)c * 12 + k];
    }
}

template <Shape SHAPE, Features FEATURES, int FUSED>
void differentiate_tiles(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                         const float* d_images, PairSums& sums, float* d_features) {
    const int tiles = state.tiles(), S = FEATURES != Features::NONE ? map.feature_channels : 0;
#pragma omp parallel
    {
        auto scratch = std::make_unique<BackwardScratch>();
        scratch->groups = groups_of(S);
        scratch->d.resize((size_t)scratch->groups * GROUP * TILE_PIXELS);
        scratch->values.resize((size_t)scratch->groups * GROUP);
#pragma omp for schedule(dynamic, 4)
        for (int tile = 0; tile < tiles; ++tile) {
            if ((region && !region[tile]) || state.tile_begin[tile] == state.tile_begin[tile + 1]) continue;
            load_tile(state, tile, S, d_images, *scratch);
            differentiate_tile<SHAPE, FEATURES, FUSED>(map, state, tile, *scratch, sums, d_features);
        }
    }
}

// Ellipsoids always have passes of their own for the features.
template <Shape SHAPE, Features FEATURES>
void differentiate_features(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                            const float* d_images, PairSums& sums, float* d_features) {
    const int groups = groups_of(map.feature_channels);
    auto run = differentiate_tiles<SHAPE, FEATURES, 1>;
    if constexpr (SHAPE == Shape::SPHERE) {
        with_constant<2, MAX_FUSED>(groups, [&](auto n) { run = differentiate_tiles<SHAPE, FEATURES, n>; });
    }
    run(map, region, state, d_images, sums, d_features);
}

template <Shape SHAPE>
void differentiate_shape(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                         const float* d_images, bool detached, PairSums& sums, float* d_features) {
    if (!map.feature_channels) {
        differentiate_tiles<SHAPE, Features::NONE, 1>(map, region, state, d_images, sums, nullptr);
    } else if (detached) {
        differentiate_features<SHAPE, Features::ALONE>(map, region, state, d_images, sums, d_features);
    } else {
        differentiate_features<SHAPE, Features::MOVE>(map, region, state, d_images, sums, d_features);
    }
}

}  // namespace

void differentiate(const Gaussians& map, const uint8_t* region, const Rasterisation& state,
                   const float* d_images, bool detached, const GradientSinks& out) {
    // Reused by later calls: allocating pages takes longer than computing the sums.
    static thread_local PairSums sums;
    sums.count = sums_of(state.shape);
    sums.own.resize(state.splats.size() * sums.count);
    sums.shared.resize((size_t)state.slots * sums.count);
    sums.shared_features.resize((size_t)state.slots * map.feature_channels);
    if (state.shape == Shape::SPHERE) {
        differentiate_shape<Shape::SPHERE>(map, region, state, d_images, detached, sums, out.features);
        finish<Shape::SPHERE>(map, state, sums, out);
    } else {
        differentiate_shape<Shape::ELLIPSOID>(map, region, state, d_images, detached, sums, out.features);
        finish<Shape::ELLIPSOID>(map, state, sums, out);
    }
}

}  // namespace semsplat
