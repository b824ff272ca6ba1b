// Vectors of W lanes, one definition per instruction set, based on the vector extensions of GCC and Clang. Kernels are
// written once with these functions; only masks and a few data movements depend on the instruction set. Without AVX,
// SSE2 or NEON the last definitions are used: any processor has them, and tests compare the others with them.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <utility>
#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#elif defined(__SSE2__)
#include <emmintrin.h>
#elif defined(__aarch64__) && defined(__ARM_NEON)
#define SIGMA_NEON                         // not on 32-bit ARM, where NEON flushes denormals and has no square root
#include <arm_neon.h>
#endif

#define SIGMA_INLINE static inline __attribute__((always_inline))

namespace sigmasplat::SIGMASPLAT_ISA {

#if defined(__AVX512F__)
constexpr int W = 16, BLOCK_WIDTH = 4, BLOCK_HEIGHT = 4;
#elif defined(__AVX2__)
constexpr int W = 8, BLOCK_WIDTH = 4, BLOCK_HEIGHT = 2;
#else
constexpr int W = 4, BLOCK_WIDTH = 2, BLOCK_HEIGHT = 2;
#endif

typedef float vf __attribute__((vector_size(W * 4)));
typedef int vi __attribute__((vector_size(W * 4)));
typedef unsigned vu __attribute__((vector_size(W * 4)));

SIGMA_INLINE vf splat(float a) { return a - vf{}; }
SIGMA_INLINE vi splat(int a) { return a - vi{}; }
SIGMA_INLINE vf load(const float* p) { vf r; memcpy(&r, p, sizeof r); return r; }
SIGMA_INLINE vi load(const int* p) { vi r; memcpy(&r, p, sizeof r); return r; }
SIGMA_INLINE void store(float* p, vf a) { memcpy(p, &a, sizeof a); }
SIGMA_INLINE void store(int* p, vi a) { memcpy(p, &a, sizeof a); }
// Load COUNT lanes; the others are 0.
template <int COUNT> SIGMA_INLINE vf load_first(const float* p) {
    if constexpr (COUNT == W) return load(p);
#if defined(__AVX512F__)
    else return (vf)_mm512_maskz_loadu_ps(__mmask16((1u << COUNT) - 1u), p);
#else
    else { vf r{}; memcpy(&r, p, COUNT * sizeof(float)); return r; }
#endif
}
// Store the first COUNT lanes.
template <int COUNT> SIGMA_INLINE void store_first(float* p, vf a) {
    if constexpr (COUNT == W) store(p, a);
#if defined(__AVX512F__)
    else _mm512_mask_storeu_ps(p, __mmask16((1u << COUNT) - 1u), (__m512)a);
#else
    else memcpy(p, &a, COUNT * sizeof(float));
#endif
}
SIGMA_INLINE vf fma(vf a, vf b, vf c) { return a * b + c; }   // contracted by -ffp-contract=fast if the instruction set has FMA
SIGMA_INLINE vf fnma(vf a, vf b, vf c) { return c - a * b; }
SIGMA_INLINE vf to_float(vi a) { return __builtin_convertvector(a, vf); }
SIGMA_INLINE vi to_int(vf a) { return __builtin_convertvector(a, vi); }  // towards zero
SIGMA_INLINE vi bits_of(vf a) { return (vi)a; }
SIGMA_INLINE vf float_of_bits(vi a) { return (vf)a; }
SIGMA_INLINE float lane_sum(vf a) { float s = 0; for (int i = 0; i < W; i++) s += a[i]; return s; }

#if defined(__AVX512F__)
typedef __mmask16 Mask;
SIGMA_INLINE Mask gt(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
SIGMA_INLINE Mask ge(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
SIGMA_INLINE Mask both(Mask a, Mask b) { return (Mask)(a & b); }
SIGMA_INLINE Mask mask_or(Mask a, Mask b) { return (Mask)(a | b); }
SIGMA_INLINE Mask mask_not(Mask a) { return (Mask)~a; }
SIGMA_INLINE bool any(Mask m) { return m != 0; }
SIGMA_INLINE unsigned bits(Mask m) { return m; }
SIGMA_INLINE Mask mask_of_bits(unsigned b) { return (Mask)b; }
SIGMA_INLINE vf select(Mask m, vf a, vf b) { return (vf)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
SIGMA_INLINE vi select(Mask m, vi a, vi b) { return (vi)_mm512_mask_blend_epi32(m, (__m512i)b, (__m512i)a); }
SIGMA_INLINE vf only(Mask m, vf a) { return (vf)_mm512_maskz_mov_ps(m, (__m512)a); }
SIGMA_INLINE vf min(vf a, vf b) { return (vf)_mm512_min_ps((__m512)a, (__m512)b); }
SIGMA_INLINE vf max(vf a, vf b) { return (vf)_mm512_max_ps((__m512)a, (__m512)b); }
SIGMA_INLINE vf sqrt(vf a) { return (vf)_mm512_sqrt_ps((__m512)a); }
SIGMA_INLINE vf floor(vf a) { return (vf)_mm512_roundscale_ps((__m512)a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
SIGMA_INLINE vf gather(const float* p, vi i) { return (vf)_mm512_i32gather_ps((__m512i)i, p, 4); }
#else
typedef vi Mask;
SIGMA_INLINE Mask gt(vf a, vf b) { return a > b; }
SIGMA_INLINE Mask ge(vf a, vf b) { return a >= b; }
SIGMA_INLINE Mask both(Mask a, Mask b) { return a & b; }
SIGMA_INLINE Mask mask_or(Mask a, Mask b) { return a | b; }
SIGMA_INLINE Mask mask_not(Mask a) { return ~a; }
SIGMA_INLINE vf select(Mask m, vf a, vf b) { return m ? a : b; }
SIGMA_INLINE vi select(Mask m, vi a, vi b) { return m ? a : b; }
SIGMA_INLINE vf only(Mask m, vf a) { return (vf)(m & (vi)a); }
SIGMA_INLINE Mask mask_of_bits(unsigned b) { vi r; for (int i = 0; i < W; i++) r[i] = (b >> i) & 1 ? -1 : 0; return r; }
#if defined(__AVX2__)
SIGMA_INLINE unsigned bits(Mask m) { return (unsigned)_mm256_movemask_ps((__m256)m); }
SIGMA_INLINE bool any(Mask m) { return _mm256_movemask_ps((__m256)m) != 0; }
SIGMA_INLINE vf min(vf a, vf b) { return (vf)_mm256_min_ps((__m256)a, (__m256)b); }
SIGMA_INLINE vf max(vf a, vf b) { return (vf)_mm256_max_ps((__m256)a, (__m256)b); }
SIGMA_INLINE vf sqrt(vf a) { return (vf)_mm256_sqrt_ps((__m256)a); }
SIGMA_INLINE vf floor(vf a) { return (vf)_mm256_floor_ps((__m256)a); }
SIGMA_INLINE vf gather(const float* p, vi i) { return (vf)_mm256_i32gather_ps(p, (__m256i)i, 4); }
#else
SIGMA_INLINE unsigned bits(Mask m) {
#if defined(__SSE2__)
    return (unsigned)_mm_movemask_ps((__m128)m);
#elif defined(SIGMA_NEON)
    return vaddvq_u32((uint32x4_t)m & uint32x4_t{1, 2, 4, 8});
#else
    unsigned r = 0; for (int i = 0; i < W; i++) r |= (unsigned)(m[i] & 1) << i; return r;
#endif
}
SIGMA_INLINE bool any(Mask m) { return bits(m) != 0; }
#if defined(__SSE2__)
SIGMA_INLINE vf min(vf a, vf b) { return (vf)_mm_min_ps((__m128)a, (__m128)b); }
SIGMA_INLINE vf max(vf a, vf b) { return (vf)_mm_max_ps((__m128)a, (__m128)b); }
SIGMA_INLINE vf sqrt(vf a) { return (vf)_mm_sqrt_ps((__m128)a); }
#else                                                 // not NEON's min and max: with a NaN these return b, as on x86
SIGMA_INLINE vf min(vf a, vf b) { return a < b ? a : b; }
SIGMA_INLINE vf max(vf a, vf b) { return a > b ? a : b; }
#if defined(SIGMA_NEON)
SIGMA_INLINE vf sqrt(vf a) { return (vf)vsqrtq_f32((float32x4_t)a); }
#else
SIGMA_INLINE vf sqrt(vf a) { vf r; for (int i = 0; i < W; i++) r[i] = __builtin_sqrtf(a[i]); return r; }
#endif
#endif
#if defined(SIGMA_NEON)
SIGMA_INLINE vf floor(vf a) { return (vf)vrndmq_f32((float32x4_t)a); }
#else
SIGMA_INLINE vf floor(vf a) { vf t = to_float(to_int(a)); return t > a ? t - 1.f : t; }
#endif
SIGMA_INLINE vf gather(const float* p, vi i) { vf r; for (int k = 0; k < W; k++) r[k] = p[i[k]]; return r; }
#endif
#endif

SIGMA_INLINE vf abs(vf a) { return max(a, -a); }
SIGMA_INLINE vf clamp(vf a, float lo, float hi) { return min(max(a, splat(lo)), splat(hi)); }
SIGMA_INLINE Mask first_lanes(int n) { return mask_of_bits(n <= 0 ? 0u : n >= 32 ? ~0u : (1u << n) - 1u); }
SIGMA_INLINE vf lane_index() { vf r; for (int i = 0; i < W; i++) r[i] = (float)i; return r; }

// a·2^n by its exponent. Unsigned: in a lane whose result is not used the sum may overflow.
SIGMA_INLINE vf times_power_of_2(vf a, vi n) { return (vf)((vu)a + ((vu)n << 23)); }

// 2^x for any x in float range (relative error 2e-9 before rounding; results below 2^-126 become 0).
SIGMA_INLINE vf exp2(vf x) {
    x = clamp(x, -126.f, 127.f);
    vf whole = floor(x + 0.5f), f = x - whole;
    vf p = fma(splat(1.534581201e-4f), f, splat(1.339993122e-3f));
    p = fma(p, f, splat(9.618488957e-3f));
    p = fma(p, f, splat(5.550328777e-2f));
    p = fma(p, f, splat(0.2402264689f));
    p = fma(p, f, splat(0.6931472057f));
    p = fma(p, f, splat(1.000000001f));
    return times_power_of_2(p, to_int(whole));
}
SIGMA_INLINE vf exp(vf x) { return exp2(x * 1.4426950408889634f); }

// 2^x for x in [-100, 0], without the clamps of `exp2`; outside this range the result is undefined. A live alpha is in
// [1/255, 1] (relative error 8e-8 before rounding). x is rounded with an addition, because the multipliers are the
// bottleneck of an alpha and the adders are idle.
SIGMA_INLINE vf exp2_alpha(vf x) {
    const vf shifted = x + 12582912.f, f = x - (shifted - 12582912.f);      // 1.5·2²³: its last bits hold round(x)
    vf p = fma(splat(1.327647217e-3f), f, splat(9.675541331e-3f));
    p = fma(p, f, splat(5.550713273e-2f));
    p = fma(p, f, splat(0.2402211972f));
    p = fma(p, f, splat(0.6931469671f));
    p = fma(p, f, splat(1.000000072f));
    return times_power_of_2(p, bits_of(shifted));
}

// log2 of positive normal numbers: exponent plus an odd series in (m-1)/(m+1), m in [sqrt(1/2), sqrt(2)).
SIGMA_INLINE vf log2(vf a) {
    vi i = bits_of(a), e = ((i - 0x3f3504f3) >> 23);
    vf m = float_of_bits(i - (e << 23));
    vf s = (m - 1.f) / (m + 1.f), s2 = s * s;
    vf p = fma(fma(fma(splat(0.4317420243f), s2, splat(0.5767141614f)), s2, splat(0.9617988495f)), s2, splat(2.88539008f));
    return fma(p, s, to_float(e));
}

// Transpose W rows of W lanes in place: log2(W) rounds of exchanges between rows `S` apart.
template <int S, int... L> SIGMA_INLINE void exchange(vf& a, vf& b, std::integer_sequence<int, L...>) {
    const vf low = __builtin_shufflevector(a, b, (L & S ? L - S + W : L)...);
    b = __builtin_shufflevector(a, b, (L & S ? L + W : L + S)...);
    a = low;
}
template <int S = 1> SIGMA_INLINE void transpose(vf* rows) {
    if constexpr (S < W) {
#pragma GCC unroll 16
        for (int i = 0; i < W; i++)
            if (!(i & S)) exchange<S>(rows[i], rows[i + S], std::make_integer_sequence<int, W>{});
        transpose<2 * S>(rows);
    }
}

// Load four floats for each lane, from p + at on: `out[k]` has the k-th of each.
typedef float four_floats __attribute__((vector_size(16)));
template <int... L, class V> SIGMA_INLINE auto joined(V a, V b, std::integer_sequence<int, L...>) { return __builtin_shufflevector(a, b, L...); }
template <int COUNT> SIGMA_INLINE auto load_fours(const float* p, const int* at) {     // those of each fourth lane
    if constexpr (COUNT == 1) { four_floats r; memcpy(&r, p + at[0], sizeof r); return r; }
    else return joined(load_fours<COUNT / 2>(p, at), load_fours<COUNT / 2>(p, at + 2 * COUNT), std::make_integer_sequence<int, 4 * COUNT>{});
}
SIGMA_INLINE void gather_fours(const float* p, vi at, vf* out) {
    constexpr auto lanes = std::make_integer_sequence<int, W>{};
    alignas(64) int from[W];
    store(from, at);
    for (int k = 0; k < 4; k++) out[k] = load_fours<W / 4>(p, from + k);
    exchange<1>(out[0], out[1], lanes);
    exchange<1>(out[2], out[3], lanes);
    exchange<2>(out[0], out[2], lanes);
    exchange<2>(out[1], out[3], lanes);
}

// Store past the caches, for values that are not read again soon. Call `fence` before another thread reads them.
#if defined(__AVX512F__)
SIGMA_INLINE void stream(float* p, vf a) { _mm512_stream_ps(p, (__m512)a); }
#elif defined(__AVX2__)
SIGMA_INLINE void stream(float* p, vf a) { _mm256_stream_ps(p, (__m256)a); }
#elif defined(__SSE2__)
SIGMA_INLINE void stream(float* p, vf a) { _mm_stream_ps(p, (__m128)a); }
#else
SIGMA_INLINE void stream(float* p, vf a) { store(p, a); }
#endif
#if defined(__SSE2__)
SIGMA_INLINE void fence() { _mm_sfence(); }
#else
SIGMA_INLINE void fence() {}
#endif

// A (BLOCK_WIDTH × BLOCK_HEIGHT) block of an image plane; rows are `stride` floats apart.
typedef float row_of_block __attribute__((vector_size(BLOCK_WIDTH * 4)));
SIGMA_INLINE row_of_block load_row(const float* p) { row_of_block r; memcpy(&r, p, sizeof r); return r; }
SIGMA_INLINE vf load_block(const float* p, size_t stride) {   // joined in registers: loading data just stored would stall
    constexpr auto two_rows = std::make_integer_sequence<int, 2 * BLOCK_WIDTH>{};
    const auto top = joined(load_row(p), load_row(p + stride), two_rows);
#if defined(__AVX512F__)                              // four rows here, two on other instruction sets
    return joined(top, joined(load_row(p + 2 * stride), load_row(p + 3 * stride), two_rows), std::make_integer_sequence<int, W>{});
#else
    return top;
#endif
}
SIGMA_INLINE void store_block(float* p, size_t stride, vf v) {
    alignas(64) float t[W];
    store(t, v);
    for (int r = 0; r < BLOCK_HEIGHT; r++) memcpy(p + r * stride, t + r * BLOCK_WIDTH, BLOCK_WIDTH * 4);
}
SIGMA_INLINE void store_block(int* p, size_t stride, vi v) {
    alignas(64) int t[W];
    store(t, v);
    for (int r = 0; r < BLOCK_HEIGHT; r++) memcpy(p + r * stride, t + r * BLOCK_WIDTH, BLOCK_WIDTH * 4);
}

}  // namespace sigmasplat::SIGMASPLAT_ISA
