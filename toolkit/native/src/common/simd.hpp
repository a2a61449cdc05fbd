// Vectors of sixteen floats for all instruction sets.
//
// AVX-512 uses one register and mask registers through intrinsics. Other instruction sets (AVX2, SSE2,
// NEON) use 16 / N vectors of N floats through the compiler's vector extension.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__)
#include <immintrin.h>
#elif defined(__SSE2__)
#include <immintrin.h>
#endif

#define SEMSPLAT_INLINE inline __attribute__((always_inline))

namespace semsplat {
namespace {

#if defined(__AVX512F__)

struct F16 {
    __m512 v;
};
typedef __mmask16 M16;

SEMSPLAT_INLINE F16 load(const float* p) { return {_mm512_loadu_ps(p)}; }
SEMSPLAT_INLINE void store(float* p, F16 a) { _mm512_storeu_ps(p, a.v); }
SEMSPLAT_INLINE F16 all(float x) { return {_mm512_set1_ps(x)}; }
// Four floats repeated: lane i is p[i % 4].
SEMSPLAT_INLINE F16 load_columns(const float* p) {
    return {_mm512_broadcast_f32x4(_mm_loadu_ps(p))};
}
// Four floats spread: lane i is p[i / 4].
SEMSPLAT_INLINE F16 load_rows(const float* p) {
    const __m512i index = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
    return {_mm512_permutexvar_ps(index, _mm512_broadcast_f32x4(_mm_loadu_ps(p)))};
}
SEMSPLAT_INLINE F16 operator+(F16 a, F16 b) { return {_mm512_add_ps(a.v, b.v)}; }
SEMSPLAT_INLINE F16 operator-(F16 a, F16 b) { return {_mm512_sub_ps(a.v, b.v)}; }
SEMSPLAT_INLINE F16 operator*(F16 a, F16 b) { return {_mm512_mul_ps(a.v, b.v)}; }
// a * b + c
SEMSPLAT_INLINE F16 fma(F16 a, F16 b, F16 c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
// c - a * b
SEMSPLAT_INLINE F16 fnma(F16 a, F16 b, F16 c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
SEMSPLAT_INLINE F16 minimum(F16 a, F16 b) { return {_mm512_min_ps(a.v, b.v)}; }
SEMSPLAT_INLINE F16 maximum(F16 a, F16 b) { return {_mm512_max_ps(a.v, b.v)}; }
SEMSPLAT_INLINE M16 ge(F16 a, F16 b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
SEMSPLAT_INLINE M16 lt(F16 a, F16 b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ); }
SEMSPLAT_INLINE M16 both(M16 a, M16 b) { return _kand_mask16(a, b); }
SEMSPLAT_INLINE F16 keep(M16 m, F16 a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
SEMSPLAT_INLINE uint32_t bits(M16 m) { return m; }
// 1 / a in full single precision, for a whose reciprocal neither overflows nor underflows.
SEMSPLAT_INLINE F16 reciprocal(F16 a) {
    const __m512 r = _mm512_rcp14_ps(a.v);
    return {_mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.0f)))};
}
SEMSPLAT_INLINE F16 round_nearest(F16 a) {
    return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)};
}
SEMSPLAT_INLINE F16 times_power_of_two(F16 a, F16 whole) {
    return {_mm512_scalef_ps(a.v, whole.v)};
}
// Folds two vectors of sums: lanes 0-7 of the result belong to a, lanes 8-15 to b (and so on, by halves).
SEMSPLAT_INLINE F16 fold8(F16 a, F16 b) {
    return {_mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x44), _mm512_shuffle_f32x4(a.v, b.v, 0xee))};
}
SEMSPLAT_INLINE F16 fold4(F16 a, F16 b) {
    return {_mm512_add_ps(_mm512_shuffle_f32x4(a.v, b.v, 0x88), _mm512_shuffle_f32x4(a.v, b.v, 0xdd))};
}
SEMSPLAT_INLINE F16 fold2(F16 a, F16 b) {
    return {_mm512_add_ps(_mm512_shuffle_ps(a.v, b.v, 0x44), _mm512_shuffle_ps(a.v, b.v, 0xee))};
}
SEMSPLAT_INLINE F16 fold1(F16 a, F16 b) {
    return {_mm512_add_ps(_mm512_shuffle_ps(a.v, b.v, 0x88), _mm512_shuffle_ps(a.v, b.v, 0xdd))};
}
// Sums of sixteen vectors, written in order.
SEMSPLAT_INLINE void sum16(const F16* x, float* out) {
    // After fold8 and fold4, each 128-bit lane contains four partial sums of one vector. The last two
    // folds work within lanes, so the order of the input vectors compensates for both.
    F16 q[4];
    for (int i = 0; i < 4; ++i) {
        q[i] = fold4(fold8(x[i], x[4 + i]), fold8(x[8 + i], x[12 + i]));
    }
    store(out, fold1(fold2(q[0], q[1]), fold2(q[2], q[3])));
}
SEMSPLAT_INLINE void sum8(const F16* x, float* out) {
    F16 q[4];
    for (int i = 0; i < 4; ++i) {
        const F16 h = fold8(x[i], x[4 + i]);
        q[i] = fold4(h, h);
    }
    const F16 r = fold1(fold2(q[0], q[1]), fold2(q[2], q[3]));
    _mm256_storeu_ps(out, _mm512_castps512_ps256(r.v));
}

#else

#if defined(__AVX2__)
enum { LANES = 8 };
#else
enum { LANES = 4 };
#endif
enum { PARTS = 16 / LANES };
typedef float FN __attribute__((vector_size(4 * LANES)));
typedef int32_t IN __attribute__((vector_size(4 * LANES)));

struct F16 {
    FN v[PARTS];
};
struct M16 {
    IN v[PARTS];
};

#define SEMSPLAT_EACH for (int i = 0; i < PARTS; ++i)
SEMSPLAT_INLINE F16 load(const float* p) {
    F16 r;
    std::memcpy(&r, p, sizeof r);
    return r;
}
SEMSPLAT_INLINE void store(float* p, F16 a) { std::memcpy(p, &a, sizeof a); }
SEMSPLAT_INLINE F16 all(float x) {
    F16 r;
    SEMSPLAT_EACH r.v[i] = x - FN{};
    return r;
}
SEMSPLAT_INLINE F16 load_columns(const float* p) {
    float r[16];
    for (int i = 0; i < 4; ++i) std::memcpy(r + 4 * i, p, 16);
    return load(r);
}
SEMSPLAT_INLINE F16 load_rows(const float* p) {
    F16 r;
#if defined(__AVX2__)
    r.v[0] = FN{p[0], p[0], p[0], p[0], p[1], p[1], p[1], p[1]};
    r.v[1] = FN{p[2], p[2], p[2], p[2], p[3], p[3], p[3], p[3]};
#else
    SEMSPLAT_EACH r.v[i] = p[i] - FN{};
#endif
    return r;
}
SEMSPLAT_INLINE F16 operator+(F16 a, F16 b) {
    SEMSPLAT_EACH a.v[i] += b.v[i];
    return a;
}
SEMSPLAT_INLINE F16 operator-(F16 a, F16 b) {
    SEMSPLAT_EACH a.v[i] -= b.v[i];
    return a;
}
SEMSPLAT_INLINE F16 operator*(F16 a, F16 b) {
    SEMSPLAT_EACH a.v[i] *= b.v[i];
    return a;
}
SEMSPLAT_INLINE F16 fma(F16 a, F16 b, F16 c) { return a * b + c; }
SEMSPLAT_INLINE F16 fnma(F16 a, F16 b, F16 c) { return c - a * b; }
SEMSPLAT_INLINE F16 minimum(F16 a, F16 b) {
    SEMSPLAT_EACH a.v[i] = a.v[i] < b.v[i] ? a.v[i] : b.v[i];
    return a;
}
SEMSPLAT_INLINE F16 maximum(F16 a, F16 b) {
    SEMSPLAT_EACH a.v[i] = a.v[i] > b.v[i] ? a.v[i] : b.v[i];
    return a;
}
SEMSPLAT_INLINE M16 ge(F16 a, F16 b) {
    M16 m;
    SEMSPLAT_EACH m.v[i] = a.v[i] >= b.v[i];
    return m;
}
SEMSPLAT_INLINE M16 lt(F16 a, F16 b) {
    M16 m;
    SEMSPLAT_EACH m.v[i] = a.v[i] < b.v[i];
    return m;
}
SEMSPLAT_INLINE M16 both(M16 a, M16 b) {
    SEMSPLAT_EACH a.v[i] &= b.v[i];
    return a;
}
SEMSPLAT_INLINE F16 keep(M16 m, F16 a) {
    SEMSPLAT_EACH a.v[i] = (FN)((IN)a.v[i] & m.v[i]);
    return a;
}
SEMSPLAT_INLINE uint32_t bits(M16 m) {
    uint32_t r = 0;
#if defined(__AVX2__)
    SEMSPLAT_EACH r |= (uint32_t)_mm256_movemask_ps((__m256)m.v[i]) << (8 * i);
#elif defined(__SSE2__)
    SEMSPLAT_EACH r |= (uint32_t)_mm_movemask_ps((__m128)m.v[i]) << (4 * i);
#else
    SEMSPLAT_EACH for (int k = 0; k < LANES; ++k) r |= (uint32_t)(m.v[i][k] & 1) << (LANES * i + k);
#endif
    return r;
}
SEMSPLAT_INLINE F16 reciprocal(F16 a) {
    SEMSPLAT_EACH a.v[i] = 1.0f / a.v[i];
    return a;
}
SEMSPLAT_INLINE F16 round_nearest(F16 a) {
    // Valid for |a| < 2^22, which exceeds any exponent.
    SEMSPLAT_EACH {
        const IN negative = a.v[i] < 0;
        const FN half = (FN)(((IN)(0.5f - FN{})) | (negative & INT32_MIN));
        a.v[i] = __builtin_convertvector(__builtin_convertvector(a.v[i] + half, IN), FN);
    }
    return a;
}
SEMSPLAT_INLINE F16 times_power_of_two(F16 a, F16 whole) {
    SEMSPLAT_EACH {
        const IN exponent = (__builtin_convertvector(whole.v[i], IN) + 127) << 23;
        a.v[i] *= (FN)exponent;
    }
    return a;
}
SEMSPLAT_INLINE float sum(F16 a) {
    FN s = a.v[0];
    for (int i = 1; i < PARTS; ++i) s += a.v[i];
    float r = 0;
    for (int k = 0; k < LANES; ++k) r += s[k];
    return r;
}
SEMSPLAT_INLINE void sum16(const F16* x, float* out) {
    for (int i = 0; i < 16; ++i) out[i] = sum(x[i]);
}
SEMSPLAT_INLINE void sum8(const F16* x, float* out) {
    for (int i = 0; i < 8; ++i) out[i] = sum(x[i]);
}
#undef SEMSPLAT_EACH

#endif

// exp(x) for x <= 0, relative error below 3e-7; underflow is clamped at exp(-40).
SEMSPLAT_INLINE F16 exp_negative(F16 x) {
    x = maximum(x, all(-40.0f)) * all(1.44269504f);
    const F16 whole = round_nearest(x);
    const F16 f = x - whole;
    F16 p = fma(f, all(1.5403530e-4f), all(1.3333558e-3f));
    p = fma(f, p, all(9.6181291e-3f));
    p = fma(f, p, all(5.5504109e-2f));
    p = fma(f, p, all(2.4022651e-1f));
    p = fma(f, p, all(6.9314718e-1f));
    p = fma(f, p, all(1.0f));
    return times_power_of_two(p, whole);
}

}  // namespace
}  // namespace semsplat
