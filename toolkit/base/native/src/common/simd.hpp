// Vectors of LANES floats, the width of the target's registers: 16 with AVX-512, 8 with AVX2, 4 with
// SSE2 and NEON.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#define SEMSPLAT_INLINE inline __attribute__((always_inline))

namespace semsplat {
namespace {

#if defined(__AVX512F__)

enum { LANES = 16 };
struct Floats {
    __m512 v;
};
typedef __mmask16 Mask;

SEMSPLAT_INLINE Floats load(const float* p) { return {_mm512_loadu_ps(p)}; }
SEMSPLAT_INLINE void store(float* p, Floats a) { _mm512_storeu_ps(p, a.v); }
SEMSPLAT_INLINE Floats all(float x) { return {_mm512_set1_ps(x)}; }
SEMSPLAT_INLINE Floats load_columns(const float* p) {
    return {_mm512_broadcast_f32x4(_mm_loadu_ps(p))};
}
SEMSPLAT_INLINE Floats load_rows(const float* p) {
    const __m512i index = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    return {_mm512_permutexvar_ps(index, _mm512_broadcast_f32x4(_mm_loadu_ps(p)))};
}
SEMSPLAT_INLINE Floats operator+(Floats a, Floats b) { return {_mm512_add_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats operator-(Floats a, Floats b) { return {_mm512_sub_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats operator*(Floats a, Floats b) { return {_mm512_mul_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats operator/(Floats a, Floats b) { return {_mm512_div_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats square_root(Floats a) { return {_mm512_sqrt_ps(a.v)}; }
SEMSPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) {
    return {_mm512_fmadd_ps(a.v, b.v, c.v)};
}
SEMSPLAT_INLINE Floats fnma(Floats a, Floats b, Floats c) {
    return {_mm512_fnmadd_ps(a.v, b.v, c.v)};
}
SEMSPLAT_INLINE Floats minimum(Floats a, Floats b) { return {_mm512_min_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats maximum(Floats a, Floats b) { return {_mm512_max_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Mask ge(Floats a, Floats b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
SEMSPLAT_INLINE Mask lt(Floats a, Floats b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ); }
SEMSPLAT_INLINE Mask both(Mask a, Mask b) { return _kand_mask16(a, b); }
SEMSPLAT_INLINE Floats keep(Mask m, Floats a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
SEMSPLAT_INLINE Floats select(Mask m, Floats a, Floats b) {
    return {_mm512_mask_blend_ps(m, b.v, a.v)};
}
SEMSPLAT_INLINE uint32_t bits(Mask m) { return m; }
// 1 / a in full single precision, for a whose reciprocal neither overflows nor underflows.
SEMSPLAT_INLINE Floats reciprocal(Floats a) {
    const __m512 r = _mm512_rcp14_ps(a.v);
    return {_mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.0f)))};
}
SEMSPLAT_INLINE Floats round_nearest(Floats a) {
    return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)};
}
SEMSPLAT_INLINE Floats truncate(Floats a) {
    return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC)};
}
SEMSPLAT_INLINE Floats times_power_of_two(Floats a, Floats exponent) {
    return {_mm512_scalef_ps(a.v, exponent.v)};
}
SEMSPLAT_INLINE Floats load_quads(const float* p, const int32_t* index) {
    __m512 r = _mm512_castps128_ps512(_mm_loadu_ps(p + 4 * (size_t)index[0]));
    r = _mm512_insertf32x4(r, _mm_loadu_ps(p + 4 * (size_t)index[4]), 1);
    r = _mm512_insertf32x4(r, _mm_loadu_ps(p + 4 * (size_t)index[8]), 2);
    return {_mm512_insertf32x4(r, _mm_loadu_ps(p + 4 * (size_t)index[12]), 3)};
}
SEMSPLAT_INLINE void transpose_quads(const Floats* q, Floats* x) {
    const __m512 a = _mm512_unpacklo_ps(q[0].v, q[1].v), b = _mm512_unpacklo_ps(q[2].v, q[3].v);
    const __m512 c = _mm512_unpackhi_ps(q[0].v, q[1].v), d = _mm512_unpackhi_ps(q[2].v, q[3].v);
    x[0] = {_mm512_shuffle_ps(a, b, 0x44)};
    x[1] = {_mm512_shuffle_ps(a, b, 0xee)};
    x[2] = {_mm512_shuffle_ps(c, d, 0x44)};
    x[3] = {_mm512_shuffle_ps(c, d, 0xee)};
}
// Adds the halves of a and of b: lanes 0-7 of the result belong to a, lanes 8-15 to b. The
// following functions do the same with groups of 8, 4 and 2 lanes.
SEMSPLAT_INLINE Floats fold8(Floats a, Floats b) {
    return {_mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x44),
                          _mm512_shuffle_f32x4(a.v, b.v, 0xee))};
}
SEMSPLAT_INLINE Floats fold4(Floats a, Floats b) {
    return {_mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x88),
                          _mm512_shuffle_f32x4(a.v, b.v, 0xdd))};
}
SEMSPLAT_INLINE Floats fold2(Floats a, Floats b) {
    return {_mm512_add_ps(_mm512_shuffle_ps(a.v, b.v, 0x44), _mm512_shuffle_ps(a.v, b.v, 0xee))};
}
SEMSPLAT_INLINE Floats fold1(Floats a, Floats b) {
    return {_mm512_add_ps(_mm512_shuffle_ps(a.v, b.v, 0x88), _mm512_shuffle_ps(a.v, b.v, 0xdd))};
}
SEMSPLAT_INLINE void sum8(const Floats* x, float* out) {
    // After fold8 and fold4, each 128-bit lane contains four partial sums of one vector. The last two
    // folds work within lanes, so the order of the input vectors compensates for both.
    Floats q[4];
    for (int i = 0; i < 4; ++i) {
        const Floats h = fold8(x[i], x[4 + i]);
        q[i] = fold4(h, h);
    }
    const Floats r = fold1(fold2(q[0], q[1]), fold2(q[2], q[3]));
    _mm256_storeu_ps(out, _mm512_castps512_ps256(r.v));
}
template <int K>
SEMSPLAT_INLINE Floats spread(Floats a) {
    return {_mm512_permute_ps(a.v, 0x55 * K)};
}
SEMSPLAT_INLINE void sum_quads(Floats x, float* out) {
    const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(x.v), _mm512_extractf32x8_ps(x.v, 1));
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
}

#elif defined(__AVX2__)

enum { LANES = 8 };
struct Floats {
    __m256 v;
};
struct Mask {
    __m256 v;
};

SEMSPLAT_INLINE Floats load(const float* p) { return {_mm256_loadu_ps(p)}; }
SEMSPLAT_INLINE void store(float* p, Floats a) { _mm256_storeu_ps(p, a.v); }
SEMSPLAT_INLINE Floats all(float x) { return {_mm256_set1_ps(x)}; }
SEMSPLAT_INLINE Floats load_columns(const float* p) {
    return {_mm256_broadcast_ps((const __m128*)p)};
}
SEMSPLAT_INLINE Floats load_rows(const float* p) {
    return {_mm256_blend_ps(_mm256_broadcast_ss(p), _mm256_broadcast_ss(p + 1), 0xf0)};
}
SEMSPLAT_INLINE Floats operator+(Floats a, Floats b) { return {_mm256_add_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats operator-(Floats a, Floats b) { return {_mm256_sub_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats operator*(Floats a, Floats b) { return {_mm256_mul_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats operator/(Floats a, Floats b) { return {_mm256_div_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats square_root(Floats a) { return {_mm256_sqrt_ps(a.v)}; }
SEMSPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) {
    return {_mm256_fmadd_ps(a.v, b.v, c.v)};
}
SEMSPLAT_INLINE Floats fnma(Floats a, Floats b, Floats c) {
    return {_mm256_fnmadd_ps(a.v, b.v, c.v)};
}
SEMSPLAT_INLINE Floats minimum(Floats a, Floats b) { return {_mm256_min_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats maximum(Floats a, Floats b) { return {_mm256_max_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Mask ge(Floats a, Floats b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
SEMSPLAT_INLINE Mask lt(Floats a, Floats b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)}; }
SEMSPLAT_INLINE Mask both(Mask a, Mask b) { return {_mm256_and_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats keep(Mask m, Floats a) { return {_mm256_and_ps(m.v, a.v)}; }
SEMSPLAT_INLINE Floats select(Mask m, Floats a, Floats b) {
    return {_mm256_blendv_ps(b.v, a.v, m.v)};
}
SEMSPLAT_INLINE uint32_t bits(Mask m) { return (uint32_t)_mm256_movemask_ps(m.v); }
SEMSPLAT_INLINE Floats reciprocal(Floats a) {
    return {_mm256_div_ps(_mm256_set1_ps(1.0f), a.v)};
}
SEMSPLAT_INLINE Floats round_nearest(Floats a) {
    return {_mm256_round_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)};
}
SEMSPLAT_INLINE Floats truncate(Floats a) {
    return {_mm256_round_ps(a.v, _MM_FROUND_TO_ZERO | _MM_FROUND_NO_EXC)};
}
SEMSPLAT_INLINE Floats load_quads(const float* p, const int32_t* index) {
    const __m256 low = _mm256_castps128_ps256(_mm_loadu_ps(p + 4 * (size_t)index[0]));
    return {_mm256_insertf128_ps(low, _mm_loadu_ps(p + 4 * (size_t)index[4]), 1)};
}
SEMSPLAT_INLINE void transpose_quads(const Floats* q, Floats* x) {
    const __m256 a = _mm256_unpacklo_ps(q[0].v, q[1].v), b = _mm256_unpacklo_ps(q[2].v, q[3].v);
    const __m256 c = _mm256_unpackhi_ps(q[0].v, q[1].v), d = _mm256_unpackhi_ps(q[2].v, q[3].v);
    x[0] = {_mm256_shuffle_ps(a, b, 0x44)};
    x[1] = {_mm256_shuffle_ps(a, b, 0xee)};
    x[2] = {_mm256_shuffle_ps(c, d, 0x44)};
    x[3] = {_mm256_shuffle_ps(c, d, 0xee)};
}
SEMSPLAT_INLINE Floats times_power_of_two(Floats a, Floats exponent) {
    const __m256i shifted = _mm256_slli_epi32(_mm256_cvtps_epi32(exponent.v), 23);
    return {_mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(a.v), shifted))};
}
// Adds the halves of a and of b: lanes 0-3 of the result belong to a, lanes 4-7 to b. The
// following functions do the same with groups of 4 and 2 lanes.
SEMSPLAT_INLINE Floats fold4(Floats a, Floats b) {
    return {_mm256_add_ps(_mm256_blend_ps(a.v, b.v, 0xf0), _mm256_permute2f128_ps(a.v, b.v, 0x21))};
}
SEMSPLAT_INLINE Floats fold2(Floats a, Floats b) {
    return {_mm256_add_ps(_mm256_shuffle_ps(a.v, b.v, 0x44), _mm256_shuffle_ps(a.v, b.v, 0xee))};
}
SEMSPLAT_INLINE Floats fold1(Floats a, Floats b) {
    return {_mm256_add_ps(_mm256_shuffle_ps(a.v, b.v, 0x88), _mm256_shuffle_ps(a.v, b.v, 0xdd))};
}
SEMSPLAT_INLINE void sum8(const Floats* x, float* out) {
    const Floats low = fold2(fold4(x[0], x[4]), fold4(x[1], x[5]));
    const Floats high = fold2(fold4(x[2], x[6]), fold4(x[3], x[7]));
    store(out, fold1(low, high));
}
template <int K>
SEMSPLAT_INLINE Floats spread(Floats a) {
    return {_mm256_permute_ps(a.v, 0x55 * K)};
}
SEMSPLAT_INLINE void sum_quads(Floats x, float* out) {
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(x.v), _mm256_extractf128_ps(x.v, 1)));
}

#else

enum { LANES = 4 };
typedef float Float4 __attribute__((vector_size(16)));
typedef int32_t Int4 __attribute__((vector_size(16)));
struct Floats {
    Float4 v;
};
struct Mask {
    Int4 v;
};

SEMSPLAT_INLINE Floats load(const float* p) {
    Floats r;
    std::memcpy(&r, p, sizeof r);
    return r;
}
SEMSPLAT_INLINE void store(float* p, Floats a) { std::memcpy(p, &a, sizeof a); }
SEMSPLAT_INLINE Floats all(float x) { return {Float4{x, x, x, x}}; }
SEMSPLAT_INLINE Floats load_columns(const float* p) { return load(p); }
SEMSPLAT_INLINE Floats load_rows(const float* p) { return all(p[0]); }
SEMSPLAT_INLINE Floats operator+(Floats a, Floats b) { return {a.v + b.v}; }
SEMSPLAT_INLINE Floats operator-(Floats a, Floats b) { return {a.v - b.v}; }
SEMSPLAT_INLINE Floats operator*(Floats a, Floats b) { return {a.v * b.v}; }
SEMSPLAT_INLINE Floats operator/(Floats a, Floats b) { return {a.v / b.v}; }
SEMSPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) { return {a.v * b.v + c.v}; }
SEMSPLAT_INLINE Floats fnma(Floats a, Floats b, Floats c) { return {c.v - a.v * b.v}; }
SEMSPLAT_INLINE Mask ge(Floats a, Floats b) { return {a.v >= b.v}; }
SEMSPLAT_INLINE Mask lt(Floats a, Floats b) { return {a.v < b.v}; }
SEMSPLAT_INLINE Mask both(Mask a, Mask b) { return {a.v & b.v}; }
SEMSPLAT_INLINE Floats keep(Mask m, Floats a) { return {(Float4)((Int4)a.v & m.v)}; }
SEMSPLAT_INLINE Floats select(Mask m, Floats a, Floats b) {
    return {(Float4)(((Int4)a.v & m.v) | ((Int4)b.v & ~m.v))};
}
// Valid for |a| < 2^31.
SEMSPLAT_INLINE Floats truncate(Floats a) {
    return {__builtin_convertvector(__builtin_convertvector(a.v, Int4), Float4)};
}
SEMSPLAT_INLINE Floats load_quads(const float* p, const int32_t* index) {
    return load(p + 4 * (size_t)index[0]);
}
SEMSPLAT_INLINE void transpose_quads(const Floats* q, Floats* x) {
    const Float4 a = __builtin_shufflevector(q[0].v, q[1].v, 0, 4, 1, 5);
    const Float4 b = __builtin_shufflevector(q[2].v, q[3].v, 0, 4, 1, 5);
    const Float4 c = __builtin_shufflevector(q[0].v, q[1].v, 2, 6, 3, 7);
    const Float4 d = __builtin_shufflevector(q[2].v, q[3].v, 2, 6, 3, 7);
    x[0] = {__builtin_shufflevector(a, b, 0, 1, 4, 5)};
    x[1] = {__builtin_shufflevector(a, b, 2, 3, 6, 7)};
    x[2] = {__builtin_shufflevector(c, d, 0, 1, 4, 5)};
    x[3] = {__builtin_shufflevector(c, d, 2, 3, 6, 7)};
}
SEMSPLAT_INLINE Floats reciprocal(Floats a) { return {1.0f / a.v}; }
#if defined(__SSE2__)
SEMSPLAT_INLINE Floats square_root(Floats a) { return {(Float4)_mm_sqrt_ps(a.v)}; }
SEMSPLAT_INLINE Floats minimum(Floats a, Floats b) { return {(Float4)_mm_min_ps(a.v, b.v)}; }
SEMSPLAT_INLINE Floats maximum(Floats a, Floats b) { return {(Float4)_mm_max_ps(a.v, b.v)}; }
SEMSPLAT_INLINE uint32_t bits(Mask m) { return (uint32_t)_mm_movemask_ps((__m128)m.v); }
// Valid for |a| < 2^31, which exceeds any exponent.
SEMSPLAT_INLINE Floats round_nearest(Floats a) {
    return {(Float4)_mm_cvtepi32_ps(_mm_cvtps_epi32(a.v))};
}
#else
SEMSPLAT_INLINE Floats square_root(Floats a) {
    return {Float4{std::sqrt(a.v[0]), std::sqrt(a.v[1]), std::sqrt(a.v[2]), std::sqrt(a.v[3])}};
}
SEMSPLAT_INLINE Floats minimum(Floats a, Floats b) { return {a.v < b.v ? a.v : b.v}; }
SEMSPLAT_INLINE Floats maximum(Floats a, Floats b) { return {a.v > b.v ? a.v : b.v}; }
SEMSPLAT_INLINE uint32_t bits(Mask m) {
    const Int4 bit = m.v & Int4{1, 2, 4, 8};
    return (uint32_t)(bit[0] | bit[1] | bit[2] | bit[3]);
}
// Valid for |a| < 2^22, which exceeds any exponent.
SEMSPLAT_INLINE Floats round_nearest(Floats a) {
    const Int4 negative = a.v < 0;
    const Float4 half = (Float4)(((Int4)(0.5f - Float4{})) | (negative & INT32_MIN));
    return {__builtin_convertvector(__builtin_convertvector(a.v + half, Int4), Float4)};
}
#endif
SEMSPLAT_INLINE Floats times_power_of_two(Floats a, Floats exponent) {
    return {(Float4)((Int4)a.v + (__builtin_convertvector(exponent.v, Int4) << 23))};
}
SEMSPLAT_INLINE Floats fold2(Floats a, Floats b) {
    return {__builtin_shufflevector(a.v, b.v, 0, 1, 4, 5) + __builtin_shufflevector(a.v, b.v, 2, 3, 6, 7)};
}
SEMSPLAT_INLINE Floats fold1(Floats a, Floats b) {
    return {__builtin_shufflevector(a.v, b.v, 0, 2, 4, 6) + __builtin_shufflevector(a.v, b.v, 1, 3, 5, 7)};
}
SEMSPLAT_INLINE void sum8(const Floats* x, float* out) {
    for (int i = 0; i < 8; i += 4) {
        store(out + i, fold1(fold2(x[i], x[i + 1]), fold2(x[i + 2], x[i + 3])));
    }
}
template <int K>
SEMSPLAT_INLINE Floats spread(Floats a) {
    return {__builtin_shufflevector(a.v, a.v, K, K, K, K)};
}
SEMSPLAT_INLINE void sum_quads(Floats x, float* out) { store(out, x); }

#endif

// The functions above, for all targets:
//   load_columns(p): four floats repeated, lane i is p[i % 4].
//   load_rows(p): each of LANES / 4 floats four times, lane i is p[i / 4].
//   fma(a, b, c): a * b + c. fnma(a, b, c): c - a * b.
//   keep(m, a): a where the mask is set, else 0. select(m, a, b): a where it is set, else b.
//   bits(m): bit i is set if lane i is.
//   truncate(a): rounded towards zero.
//   load_quads(p, index): lanes 4 g to 4 g + 3 are the four floats at p + 4 * index[4 g].
//   transpose_quads(q, x): lane 4 g + j of x[k] is lane 4 g + k of q[j], for four vectors.
//   times_power_of_two(a, e): a * 2^e for a in [0.5, 2] and integers |e| < 125.
//   sum8(x, out): the sums of the lanes of eight vectors, in order.
//   spread<k>(a): lane 4 g + j is lane 4 g + k of a.
//   sum_quads(x, out): out[j] is the sum of the lanes 4 g + j.

// Gathers groups of four floats: lane i of x[k] is p[4 * index[i] + k].
SEMSPLAT_INLINE void gather4(const float* p, const int32_t* index, Floats (&x)[4]) {
    Floats quads[4];
    for (int j = 0; j < 4; ++j) quads[j] = load_quads(p, index + j);
    transpose_quads(quads, x);
}

// Sums of groups of four lanes: lane 4 g + k of the result is the sum of lanes 4 g to 4 g + 3 of x[k].
SEMSPLAT_INLINE Floats sums_of_quads(const Floats (&x)[4]) {
    return fold1(fold2(x[0], x[1]), fold2(x[2], x[3]));
}

// Calls f with the integral constants 0 to 3.
template <class F>
SEMSPLAT_INLINE void for_four(const F& f) {
    f(std::integral_constant<int, 0>());
    f(std::integral_constant<int, 1>());
    f(std::integral_constant<int, 2>());
    f(std::integral_constant<int, 3>());
}

// exp(x) for -80 <= x <= 80, relative error below 3e-7.
SEMSPLAT_INLINE Floats exponential_in_range(Floats x) {
    x = x * all(1.44269504f);
    const Floats exponent = round_nearest(x);
    const Floats f = x - exponent;
    Floats p = fma(f, all(1.5403530e-4f), all(1.3333558e-3f));
    p = fma(f, p, all(9.6181291e-3f));
    p = fma(f, p, all(5.5504109e-2f));
    p = fma(f, p, all(2.4022651e-1f));
    p = fma(f, p, all(6.9314718e-1f));
    p = fma(f, p, all(1.0f));
    return times_power_of_two(p, exponent);
}

// exp(x) for x <= 0; underflow is clamped at exp(-40).
SEMSPLAT_INLINE Floats exp_negative(Floats x) { return exponential_in_range(maximum(x, all(-40.0f))); }

// exp(x), clamped at exp(-80) and exp(80).
SEMSPLAT_INLINE Floats exponential(Floats x) {
    return exponential_in_range(minimum(maximum(x, all(-80.0f)), all(80.0f)));
}

// Natural logarithm of normal positive numbers, relative error below 1e-6.
SEMSPLAT_INLINE Floats logarithm(Floats x) {
    float values[LANES];
    store(values, x);
    for (int i = 0; i < LANES; ++i) {  // the compiler vectorises this loop
        int32_t raw;
        std::memcpy(&raw, values + i, 4);
        const int32_t shifted = raw - 0x3f3504f3;  // sqrt(1/2): the mantissa is then near 1
        const int32_t exponent = shifted >> 23;
        const int32_t mantissa_bits = raw - (exponent << 23);
        float m;
        std::memcpy(&m, &mantissa_bits, 4);
        const float f = (m - 1.0f) / (m + 1.0f), q = f * f;
        const float series = f * (2.0f + q * (0.66666667f + q * (0.4f + q * (0.28571430f + q * 0.2222222f))));
        values[i] = series + (float)exponent * 0.69314718f;
    }
    return load(values);
}

// Applies f to the first `count` values in place; the array's size must be a multiple of LANES.
template <class F>
SEMSPLAT_INLINE void for_vectors(float* values, int count, const F& f) {
    for (int i = 0; i < count; i += LANES) store(values + i, f(load(values + i)));
}

}  // namespace
}  // namespace semsplat
