// Tracking by Adam without the host: the papers' loss on a render with its gradient, and the step of the pose. Included
// by fit.cu. fit/tracking_loss.py, fit/tracking_loss.py, fit/descent.py and fit/descent.py are the definitions;
// native/track.h is the CPU version.
#pragma once

namespace sigmasplat {

// ---- medians --------------------------------------------------------------------------------------------------------

// Floats ≥ 0 have the same order as their bits. The median (lower middle value) of an image is found in three passes.
// The first pass counts floats by their upper 11 of 31 bits, which gives these bits of the median. The other passes
// count the floats that share them by the next 10 and the last 10 bits. Counts are whole numbers, so the sum does not
// depend on the order of additions.
constexpr int PASSES = 3, DIGITS = 2048, EACH = DIGITS / THREADS;
inline float infinite() { return __int_as_float(0x7f800000); }

struct Digits { unsigned bits; int rank; };           // bits known so far; rank among the floats that share them, −1 = none
struct Selection { int* counts; Digits* known; };     // [medians, PASSES, DIGITS], initially 0; [medians, PASSES]
enum Median { OF_DEPTH, OF_COLOR, OF_VARIANCE };      // errors of depth and of colour; V + ε of each channel

// Find the digit of a median that a pass has counted. Every block does this, which saves a launch; the first block
// stores the result for the kernels after the next one. All threads must call this.
inline Digits next_digits(const Selection& s, int median, int pass) {
    __shared__ int of_warps[THREADS / 32];
    __shared__ Digits found;
    const int t = int(threadIdx.x), lane = t % 32, warp = t / 32, at = median * PASSES + pass;
    const int* counts = s.counts + size_t(at) * DIGITS + t * EACH;
    int mine = 0;
    for (int k = 0; k < EACH; k++) mine += counts[k];
    int up_to = mine;
    for (int apart = 1; apart < 32; apart *= 2) {
        const int below = __shfl_sync(ALL_LANES, up_to, (lane - apart) & 31);
        if (lane >= apart) up_to += below;
    }
    if (lane == 31) of_warps[warp] = up_to;
    __syncthreads();
    int before = up_to - mine, total = 0;
    for (int w = 0; w < THREADS / 32; w++) {
        if (w < warp) before += of_warps[w];
        total += of_warps[w];
    }
    Digits known = {0u, total ? (total - 1) / 2 : -1};
    if (pass) known = s.known[at - 1];
    if (known.rank >= before && known.rank < before + mine) {
        int digit = t * EACH, rank = known.rank - before;
        for (int k = 0; rank >= counts[k]; k++, digit++) rank -= counts[k];
        found = {known.bits << (pass ? 10 : 11) | unsigned(digit), rank};
    }
    if (known.rank < 0 && t == 0) found = known;
    __syncthreads();
    const Digits result = found;
    __syncthreads();                                  // before another call overwrites it
    if (blockIdx.x == 0 && t == 0) s.known[at] = result;
    return result;
}

struct Images {                            // planes [K, H, W] of a render; target; number of threads for all pixels
    const float *sums, *alpha, *color, *depth;
    long long pixels, threads;
};

// Count floats by their digit number `pass`. value(at, median) returns the float, or −1 for a pixel without one.
template <int FIRST, int COUNT, class Value>
inline void count_digits(const Images& im, const Selection& s, int pass, Value value) {
    __shared__ int bins[COUNT * DIGITS];
    Digits known[COUNT] = {};
    if (pass)
        for (int q = 0; q < COUNT; q++) known[q] = next_digits(s, FIRST + q, pass - 1);
    for (int k = int(threadIdx.x); k < COUNT * DIGITS; k += THREADS) bins[k] = 0;
    __syncthreads();
    const int shift = 20 - 10 * pass;
    for (long long at = thread_number(); at < im.pixels; at += im.threads)
        for (int q = 0; q < COUNT; q++) {
            const float x = value(size_t(at), FIRST + q);
            if (x < 0.f) continue;
            const unsigned bits = unsigned(__float_as_int(x == x ? x : infinite()));
            const unsigned digit = bits >> shift & (pass ? 1023u : 2047u);
            if (!pass || bits >> (shift + 10) == known[q].bits) atomicAdd(&bins[q * DIGITS + int(digit)], 1);
        }
    __syncthreads();
    for (int k = int(threadIdx.x); k < COUNT * DIGITS; k += THREADS)
        if (bins[k]) atomicAdd(&s.counts[(size_t(FIRST + k / DIGITS) * PASSES + pass) * DIGITS + k % DIGITS], bins[k]);
}

// ---- the tracking loss ----------------------------------------------------------------------------------------------

struct TrackNumbers { float alpha_above, alpha_power, outlier_factor, outlier_factor_color, weight_color, tau, weight_max; };
struct Exposure { float gain, offset; };              // of exp(a)·Ĉ + b

inline bool may_count(const Images& im, const TrackNumbers& o, size_t at) {
    return im.depth[at] > 0.f && (o.alpha_above <= 0.f || im.alpha[at] > o.alpha_above);
}
inline float depth_error(const Images& im, size_t at) { return im.sums[3 * im.pixels + at] - im.depth[at]; }
inline float color_error(const Images& im, const Exposure& e, size_t at, int c) {
    return fmaf(e.gain, im.sums[c * im.pixels + at], e.offset - im.color[c * im.pixels + at]);
}
inline float color_distance(const Images& im, const Exposure& e, size_t at) {
    return fabsf(color_error(im, e, at, 0)) + fabsf(color_error(im, e, at, 1)) + fabsf(color_error(im, e, at, 2));
}
inline float variance_at(const Images& im, size_t at, int c) {   // V + ε, with V clamped at 0 from below
    const float color = im.sums[c * im.pixels + at];
    return fmaxf(fmaf(-color, color, im.sums[(4 + c) * im.pixels + at]), 0.f) + NLL_EPSILON;
}

KERNEL count_errors(Images im, TrackNumbers o, const Exposure* exposure, Selection s, int pass) {
    const Exposure e = *exposure;
    const bool of_color = o.outlier_factor_color > 0.f;
    count_digits<OF_DEPTH, 2>(im, s, pass, [&](size_t at, int median) {
        if (!may_count(im, o, at) || (median == OF_COLOR && !of_color)) return -1.f;
        return median == OF_DEPTH ? fabsf(depth_error(im, at)) : color_distance(im, e, at);
    });
}

// factor × a median; infinite if the factor is 0 or no pixel counts. All threads must call this.
inline float outlier_limit(const Selection& s, int median, float factor) {
    if (factor <= 0.f) return infinite();
    const Digits found = next_digits(s, median, PASSES - 1);
    return found.rank < 0 ? infinite() : factor * __int_as_float(int(found.bits));
}

struct Limits { float depth, color; bool own; };      // own: colour has its own mask, otherwise that of depth
inline Limits limits_of(const Selection& s, const TrackNumbers& o) {
    return {outlier_limit(s, OF_DEPTH, o.outlier_factor), outlier_limit(s, OF_COLOR, o.outlier_factor_color), o.outlier_factor_color > 0.f};
}
inline bool in_depth(const Images& im, const TrackNumbers& o, const Limits& limits, size_t at) {
    return may_count(im, o, at) && fabsf(depth_error(im, at)) <= limits.depth;
}
inline bool in_color(const Images& im, const TrackNumbers& o, const Limits& limits, const Exposure& e, size_t at) {
    return limits.own ? may_count(im, o, at) && color_distance(im, e, at) <= limits.color : in_depth(im, o, limits, at);
}

KERNEL count_variances(Images im, TrackNumbers o, const Exposure* exposure, Selection s, int pass) {
    const Exposure e = *exposure;
    const Limits limits = limits_of(s, o);
    count_digits<OF_VARIANCE, 3>(im, s, pass, [&](size_t at, int median) {
        return in_color(im, o, limits, e, at) ? variance_at(im, at, median - OF_VARIANCE) : -1.f;
    });
}

// Count the pixels used for colour and for depth: kept [2], initially 0.
KERNEL count_kept(Images im, TrackNumbers o, const Exposure* exposure, Selection s, int* kept) {
    const Exposure e = *exposure;
    const Limits limits = limits_of(s, o);
    int mine[2] = {};
    for (long long at = thread_number(); at < im.pixels; at += im.threads) {
        mine[0] += in_color(im, o, limits, e, size_t(at));
        mine[1] += in_depth(im, o, limits, size_t(at));
    }
    for (int q = 0; q < 2; q++) {
        for (int apart = 16; apart > 0; apart /= 2) mine[q] += __shfl_xor_sync(ALL_LANES, mine[q], apart);
        if (threadIdx.x % 32 == 0) atomicAdd(&kept[q], mine[q]);
    }
}

inline float weight_each(float weight, int channels, int kept) { return kept ? weight / float(channels * kept) : 0.f; }

// Write the gradient of L_track with respect to all rendered planes. Store, per block, the sums of the loss and of its
// gradient with respect to (a, b) of the exposure. kept: null if the mean is over the image. weigh: whether to use w̃
// (VarSplat §3), whose medians must have been counted.
KERNEL tracking_loss(Images im, TrackNumbers o, const Exposure* exposure, Selection s, const int* kept, int weigh, int planes,
                     float* on_sums, double* sums) {
    const Exposure e = *exposure;
    const Limits limits = limits_of(s, o);
    float log_median[3] = {};
    for (int c = 0; c < 3 && weigh; c++) {
        const Digits found = next_digits(s, OF_VARIANCE + c, PASSES - 1);
        weigh = found.rank >= 0;                      // the same pixels in every channel
        log_median[c] = log2f(__int_as_float(int(found.bits)));
    }
    const float per_color = kept ? weight_each(o.weight_color, 3, kept[0]) : o.weight_color / float(im.pixels);
    const float per_depth = kept ? weight_each(1.f - o.weight_color, 1, kept[1]) : (1.f - o.weight_color) / float(im.pixels);
    float total[3] = {};
    for (long long at = thread_number(); at < im.pixels; at += im.threads) {
        const size_t i = size_t(at);
        const float soft = o.alpha_power == 0.f ? 1.f : exp2f(o.alpha_power * log2f(fmaxf(im.alpha[i], 1e-30f)));
        const bool counts = in_color(im, o, limits, e, i), near = in_depth(im, o, limits, i);
        for (int c = 0; c < 3; c++) {
            float on = 0.f;
            if (counts) {
                const float error = color_error(im, e, i, c);
                float weight = per_color * soft;
                if (weigh) {
                    const float power = (log_median[c] - log2f(variance_at(im, i, c))) / o.tau;
                    weight *= fminf(fmaxf(exp2f(power), 1.f / o.weight_max), o.weight_max);
                }
                const float by_color = signed_weight(error, weight);
                on = e.gain * by_color;
                total[0] += weight * fabsf(error);
                total[1] = fmaf(on, im.sums[c * im.pixels + i], total[1]);
                total[2] += by_color;
            }
            on_sums[c * im.pixels + i] = on;
        }
        const float error = near ? depth_error(im, i) : 0.f, weight = per_depth * soft;
        total[0] += weight * fabsf(error);
        on_sums[3 * im.pixels + i] = signed_weight(error, weight);
        for (int c = 4; c < planes; c++) on_sums[c * im.pixels + i] = 0.f;
    }
    store_sums<3>(total, sums);
}

}  // namespace sigmasplat

#include "descend.cuh"
