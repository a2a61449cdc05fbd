// Shared by the forward and backward pass: a batch of a tile's splats.
//
// A tile of 16x16 pixels consists of blocks of 4x4 or 4x2 pixels. A sphere is separable,
// exp(k dx^2) exp(k dy^2), so 32 exponentials suffice for all pixels of a tile.
#pragma once

#include <algorithm>
#include <type_traits>

#include "common/simd.hpp"
#include "rendering/splats.hpp"

namespace semsplat {
namespace {

enum { BATCH = 128, PREFETCHED = 12 };  // splats
// A block is one vector of 16 or 8 lanes, or two of 4. Small blocks fit small Gaussians better, but
// every block has a constant cost.
enum {
    PARTS = LANES >= 8 ? 1 : 2,
    BLOCK_PIXELS = PARTS * LANES,
    BLOCK_ROWS = BLOCK_PIXELS / 4,
    BLOCKS = TILE_PIXELS / BLOCK_PIXELS,
};
constexpr uint32_t ALL_BLOCKS = 0xffffffffu >> (32 - BLOCKS);

struct alignas(64) TileEntry {
    // Sphere: exp(k dx^2) of the tile's 16 columns, and opacity * exp(k dy^2) of its 16 rows.
    // Ellipsoid: dx and dy.
    float columns[16], rows[16];
    float r, g, b, z;
    float u, v;         // centre relative to the tile's first pixel
    int32_t id, splat, slot;
    uint32_t blocks;    // bit i: block i is within the support
    float shape_a, shape_b, shape_c, opacity;  // of an ellipsoid; see Splat
    Slope slope;
};
static_assert(sizeof(TileEntry) == 192, "three cache lines");

alignas(64) constexpr float COUNTING[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
// First columns and rows of the blocks.
alignas(64) constexpr float BLOCK_LEFT[4] = {0, 4, 8, 12};
alignas(64) constexpr float BLOCK_TOP[8] = {0, BLOCK_ROWS, 2 * BLOCK_ROWS, 3 * BLOCK_ROWS,
                                            4 * BLOCK_ROWS, 5 * BLOCK_ROWS, 6 * BLOCK_ROWS, 7 * BLOCK_ROWS};

SEMSPLAT_INLINE int block_column(int block) { return 4 * (block & 3); }
SEMSPLAT_INLINE int block_row(int block) { return BLOCK_ROWS * (block >> 2); }

// Distance of zero from the intervals [begin, begin + length].
SEMSPLAT_INLINE Floats outside(Floats begin, float length) {
    const Floats zero = all(0.0f);
    return maximum(maximum(begin, zero - (begin + all(length))), zero);
}

SEMSPLAT_INLINE void prepare_values(const Splat& s, float u, float v, TileEntry& e) {
    e.r = s.r;
    e.g = s.g;
    e.b = s.b;
    e.z = s.z;
    e.u = u;
    e.v = v;
    e.id = s.id;
}

SEMSPLAT_INLINE void prepare_sphere(const Splat& s, float left, float top, TileEntry& e) {
    const float u = s.u - left, v = s.v - top;
    const Floats k = all(s.shape_a), opacity = all(s.opacity), support = all(s.support);
    for (int first = 0; first < TILE; first += LANES) {
        const Floats dx = load(COUNTING + first) - all(u), dy = load(COUNTING + first) - all(v);
        store(e.columns + first, exp_negative(k * dx * dx));
        store(e.rows + first, opacity * exp_negative(k * dy * dy));
    }
    // Squared distance from the centre to the nearest pixel of each block.
    const Floats x = outside(load_columns(BLOCK_LEFT) - all(u), 3.0f);
    uint32_t blocks = 0;
    for (int first = 0; first < BLOCKS; first += LANES) {
        const Floats y = outside(load_rows(BLOCK_TOP + first / 4) - all(v), BLOCK_ROWS - 1);
        blocks |= bits(ge(support, fma(x, x, y * y))) << first;
    }
    e.blocks = blocks;
    prepare_values(s, u, v, e);
}

SEMSPLAT_INLINE Floats clamped(Floats x, Floats least, Floats most) { return minimum(maximum(x, least), most); }

SEMSPLAT_INLINE void prepare_ellipsoid(const Splat& s, const Slope& slope, float left, float top, TileEntry& e) {
    const float u = s.u - left, v = s.v - top;
    for (int first = 0; first < TILE; first += LANES) {
        store(e.columns + first, load(COUNTING + first) - all(u));
        store(e.rows + first, load(COUNTING + first) - all(v));
    }
    // The smallest value of the quadratic form (a x + b y)^2 + (c y)^2 over each block. If the centre is
    // outside, it lies on the edges that face it.
    const Floats a = all(s.shape_a), b = all(s.shape_b), c = all(s.shape_c), support = all(s.support), zero = all(0.0f);
    const Floats along_x = all(-s.shape_b / s.shape_a);
    const Floats along_y = all(-s.shape_a * s.shape_b / (s.shape_b * s.shape_b + s.shape_c * s.shape_c));
    const Floats x0 = load_columns(BLOCK_LEFT) - all(u), x1 = x0 + all(3.0f);
    const Floats x = clamped(zero, x0, x1);
    uint32_t blocks = 0;
    for (int first = 0; first < BLOCKS; first += LANES) {
        const Floats y0 = load_rows(BLOCK_TOP + first / 4) - all(v), y1 = y0 + all(BLOCK_ROWS - 1);
        const Floats y = clamped(zero, y0, y1);
        const Floats across = clamped(along_x * y, x0, x1), down = clamped(along_y * x, y0, y1);
        const Floats beside = fma(a, x, b * down), below = c * down, above = fma(a, across, b * y), at_y = c * y;
        const Floats least = minimum(fma(beside, beside, below * below), fma(above, above, at_y * at_y));
        blocks |= bits(ge(support, least)) << first;
    }
    e.blocks = blocks;
    e.shape_a = s.shape_a;
    e.shape_b = s.shape_b;
    e.shape_c = s.shape_c;
    e.opacity = s.opacity;
    e.slope = slope;
    prepare_values(s, u, v, e);
}

// Prepares the splat with index i.
template <Shape SHAPE>
SEMSPLAT_INLINE void prepare(const Rasterisation& state, int32_t i, float left, float top, TileEntry& e) {
    if (SHAPE == Shape::SPHERE) {
        prepare_sphere(state.splats[i], left, top, e);
    } else {
        prepare_ellipsoid(state.splats[i], state.slopes[i], left, top, e);
    }
}

// Coordinates s, t of an ellipsoid at the pixels of one part of a block; the exponent is -(s^2 + t^2).
SEMSPLAT_INLINE void whitened(const TileEntry& e, int block, int part, Floats& s, Floats& t) {
    const Floats x = load_columns(e.columns + block_column(block));
    const Floats y = load_rows(e.rows + block_row(block) + LANES / 4 * part);
    s = fma(all(e.shape_a), x, all(e.shape_b) * y);
    t = all(e.shape_c) * y;
}

// Opacity times Gaussian of an entry at the pixels of one part of a block, and its depth there.
template <Shape SHAPE>
SEMSPLAT_INLINE Floats gaussian_of(const TileEntry& e, int block, int part, Floats& depth) {
    depth = all(e.z);
    if (SHAPE == Shape::SPHERE) {
        return load_columns(e.columns + block_column(block)) *
               load_rows(e.rows + block_row(block) + LANES / 4 * part);
    }
    Floats s, t;
    whitened(e, block, part, s, t);
    depth = fma(all(e.slope.along_s), s, fma(all(e.slope.along_t), t, depth));
    return all(e.opacity) * exp_negative(fnma(s, s, all(0.0f) - t * t));
}

// Calls f with the integral constant n if it is from FIRST to LAST.
template <int FIRST, int LAST, class F>
SEMSPLAT_INLINE void with_constant(int n, const F& f) {
    if constexpr (FIRST <= LAST) {
        if (n == FIRST) {
            f(std::integral_constant<int, FIRST>());
        } else {
            with_constant<FIRST + 1, LAST>(n, f);
        }
    }
}

}  // namespace
}  // namespace semsplat
