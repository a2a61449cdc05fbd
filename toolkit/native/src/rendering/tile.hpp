// Shared by the forward and backward pass: a batch of a tile's splats.
//
// A tile of 16x16 pixels has 16 blocks of 4x4 pixels; a block is one F16. The Gaussian is separable,
// exp(k dx^2) exp(k dy^2): two vector exponentials give all columns and all rows of a tile.
#pragma once

#include "common/simd.hpp"
#include "rendering/splats.hpp"

namespace semsplat {
namespace {

enum { BATCH = 128 };

struct alignas(64) TileEntry {
    float columns[16];  // exp(k dx^2) of the tile's 16 columns
    float rows[16];     // opacity * exp(k dy^2) of its 16 rows
    float r, g, b, z;
    float u, v;         // centre relative to the tile's first pixel
    int32_t id, splat, slot;
    uint32_t blocks;    // bit i: block i is within the support
    int32_t padding[6];
};
static_assert(sizeof(TileEntry) == 192, "three cache lines");

alignas(64) constexpr float COUNTING[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
// First column and first row of each block.
alignas(64) constexpr float BLOCK_X[16] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
alignas(64) constexpr float BLOCK_Y[16] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};

SEMSPLAT_INLINE void prepare(const Splat& s, float left, float top, TileEntry& e) {
    const float u = s.u - left, v = s.v - top;
    const F16 dx = load(COUNTING) - all(u), dy = load(COUNTING) - all(v);
    const F16 k = all(s.exponent);
    store(e.columns, exp_negative(k * dx * dx));
    store(e.rows, all(s.opacity) * exp_negative(k * dy * dy));
    e.r = s.r;
    e.g = s.g;
    e.b = s.b;
    e.z = s.z;
    e.u = u;
    e.v = v;
    e.id = s.id;
    // Distance from the centre to the nearest pixel of each block.
    const F16 bx = load(BLOCK_X) - all(u), by = load(BLOCK_Y) - all(v);
    const F16 zero = all(0.0f), three = all(3.0f);
    const F16 x = maximum(maximum(bx, zero - (bx + three)), zero);
    const F16 y = maximum(maximum(by, zero - (by + three)), zero);
    e.blocks = bits(ge(all(s.support_squared), fma(x, x, y * y)));
}

SEMSPLAT_INLINE const float* columns_of(const TileEntry& e, int block) {
    return e.columns + 4 * (block & 3);
}
SEMSPLAT_INLINE const float* rows_of(const TileEntry& e, int block) {
    return e.rows + 4 * (block >> 2);
}

// Maximum number of feature channels that a loop keeps in registers.
#if defined(__AVX512F__)
enum { WIDEST = 16 };
#else
enum { WIDEST = 4 };
#endif

}  // namespace
}  // namespace semsplat
