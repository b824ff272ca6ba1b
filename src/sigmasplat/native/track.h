// What tracking computes from a render: pixel weights, the papers' loss with its gradient, and the reference of
// alignment. fit/tracking_loss.py has the definitions.

constexpr float WEIGHT_EPSILON = 1e-6f;

// Select the median of an image's floats ≥ 0 by their bits, which have the same order. First by the upper 11 bits, in
// parallel over rows; then among the floats that share these bits.
constexpr int DIGITS = 2048;
struct Selection { Buffer<int> keys, counts; };

// The lower of the two middle values of n ≥ 1 numbers of 31 bits that share their upper 11 bits.
static uint32_t select_low_bits(int* keys, int64_t n, int64_t rank) {
    uint32_t found = 0;
    for (int shift : {10, 0}) {
        int64_t counts[1024] = {};
        for (int64_t i = 0; i < n; i++) counts[keys[i] >> shift & 1023]++;
        uint32_t digit = 0;
        while (rank >= counts[digit]) rank -= counts[digit++];
        found |= digit << shift;
        int64_t kept = 0;
        for (int64_t i = 0; i < n; i++) { keys[kept] = keys[i]; kept += uint32_t(keys[i] >> shift & 1023) == digit; }
        n = kept;
    }
    return found;
}

// The median (lower middle value) of value(at) [lanes] over the pixels where chosen(at, value) is true. Returns false
// if there are none.
template <class Value, class Chosen>
static bool lower_median(const Plane& p, Selection& s, Value value, Chosen chosen, float* median) {
    const int threads = omp_get_max_threads();
    int* keys = s.keys.reserve(p.stride * p.height + W);
    int* counts = s.counts.reserve(size_t(threads) * 2 * DIGITS);
    memset(counts, 0, size_t(threads) * 2 * DIGITS * sizeof(int));
#pragma omp parallel num_threads(threads)
    {
        int* mine = counts + size_t(omp_get_thread_num()) * 2 * DIGITS;   // the upper half counts pixels that are not chosen
#pragma omp for schedule(static)
        for (int y = 0; y < p.height; y++) {
            int* row = keys + size_t(y) * p.stride;
            for (int x = 0; x < p.width; x += W) {
                const vf v = value(size_t(y) * p.stride + x);
                store(row + x, select(both(first_lanes(p.width - x), chosen(size_t(y) * p.stride + x, v)), bits_of(v), splat(-1)));
            }
            for (int x = 0; x < p.width; x++) mine[uint32_t(row[x]) >> 20]++;
        }
    }
    int64_t n = 0, before = 0;
    for (int q = 0; q < DIGITS; q++)
        for (int t = 0; t < threads; t++) n += counts[size_t(t) * 2 * DIGITS + q];
    if (!n) return false;
    const int64_t rank = (n - 1) / 2;
    int digit = 0;
    for (;; digit++) {
        int64_t here = 0;
        for (int t = 0; t < threads; t++) here += counts[size_t(t) * 2 * DIGITS + digit];
        if (rank < before + here) break;
        before += here;
    }
    int64_t kept = 0;                                 // overwrites only keys that were already read
    for (int y = 0; y < p.height; y++)
        for (int x = 0; x < p.width; x++) {
            const int key = keys[size_t(y) * p.stride + x];
            keys[kept] = key;
            kept += key >> 20 == digit;
        }
    const uint32_t bits = uint32_t(digit) << 20 | select_low_bits(keys, kept, rank - before);
    memcpy(median, &bits, 4);
    return true;
}

SIGMA_INLINE vf variance_of(const float* sums, const Plane& p, size_t at, int c) {   // V + ε, with V clamped at 0 from below
    const vf color = load(sums + c * p.plane + at);
    return max(fnma(color, color, load(sums + (4 + c) * p.plane + at)), splat(0.f)) + WEIGHT_EPSILON;
}

// log2 of the median of V + ε over the chosen pixels, per channel. Returns false if there are none.
template <class Chosen>
static bool median_log_variance(const float* sums, const Plane& p, Selection& s, Chosen chosen, float* log_median) {
    for (int c = 0; c < 3; c++) {
        float median;
        const auto value = [&](size_t at) { return variance_of(sums, p, at, c); };
        if (!lower_median(p, s, value, [&](size_t at, vf) { return chosen(at); }, &median)) return false;
        log_median[c] = log2f(median);
    }
    return true;
}

// exp(−(log(V+ε) − median)/τ), clamped (VarSplat §3), as a function of V + ε.
SIGMA_INLINE vf confidence(vf variance, float log_median, const TrackOptions& o) {
    return clamp(exp2((log_median - log2(variance)) * (1.f / o.tau)), 1.f / o.weight_max, o.weight_max);
}
// w̃ of channel c.
SIGMA_INLINE vf uncertainty_weight(const float* sums, const Plane& p, size_t at, int c, const TrackOptions& o, float log_median) {
    return confidence(variance_of(sums, p, at, c), log_median, o);
}

// factor × the median of an error over the chosen pixels; infinite if the factor is 0 or there are none.
template <class Error, class Chosen>
static float outlier_limit(const Plane& p, Selection& s, float factor, Error error, Chosen chosen) {
    float median;
    const bool found = factor > 0.f && lower_median(p, s, error, [&](size_t at, vf) { return chosen(at); }, &median);
    return found ? factor * median : __builtin_inff();
}

// The weight of one error in a mean: over the image's pixels (all channels together), or over each channel of the used
// pixels.
template <class Chosen>
static float per_value(const Plane& p, bool kept, float weight, int channels, Chosen chosen) {
    if (!kept) return weight / (float(p.width) * float(p.height));
    int64_t n = 0;
#pragma omp parallel for schedule(static) reduction(+ : n)
    for (int y = 0; y < p.height; y++)
        for (int x = 0; x < p.width; x += W)
            n += __builtin_popcount(bits(both(first_lanes(p.width - x), chosen(size_t(y) * p.stride + x))));
    return n ? weight / float(channels * n) : 0.f;
}

// L_track (VarSplat §3; CG-SLAM §6) as a mean over pixels. Writes its gradient with respect to colour and depth to
// planes and returns the loss. g_exposure [2] is the gradient with respect to (a, b) of exp(a)·Ĉ + b. The masks need
// the medians of the errors, the weights those of V.
static double tracking_loss(const float* sums, const float* alpha, bool variance, const float* target_color,
                            const float* target_depth, Plane p, TrackOptions o, float gain, float offset, float* g_sums,
                            double* g_exposure) {
    static thread_local Selection scratch;            // each thread that calls has its own
    const float* depth = sums + 3 * p.plane;
    const auto error_at = [&](size_t at) { return abs(load(depth + at) - load(target_depth + at)); };
    const auto counts = [&](size_t at) {
        const Mask read = gt(load(target_depth + at), splat(0.f));
        return o.alpha_above > 0.f ? both(read, gt(load(alpha + at), splat(o.alpha_above))) : read;
    };
    const auto color_error_at = [&](size_t at) {
        vf total = splat(0.f);
        for (int c = 0; c < 3; c++)
            total += abs(fma(splat(gain), load(sums + c * p.plane + at), offset - load(target_color + c * p.plane + at)));
        return total;
    };
    const float limit = outlier_limit(p, scratch, o.outlier_factor, error_at, counts);
    const float limit_color = outlier_limit(p, scratch, o.outlier_factor_color, color_error_at, counts);
    const bool own = o.outlier_factor_color > 0.f;    // colour has its own mask, otherwise that of depth
    const auto in_depth = [&](size_t at) { return both(counts(at), ge(splat(limit), error_at(at))); };
    const auto in_color = [&](size_t at) { return own ? both(counts(at), ge(splat(limit_color), color_error_at(at))) : in_depth(at); };
    float log_median[3];
    const bool weigh = o.uncertainty && variance && median_log_variance(sums, p, scratch, in_color, log_median);
    const float per_color = per_value(p, o.kept, o.weight_color, 3, in_color), per_depth = per_value(p, o.kept, 1.f - o.weight_color, 1, in_depth);
    Buffer<double> rows;
    rows.reserve(size_t(p.height) * 3);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < p.height; y++) {
        vf total[3] = {splat(0.f), splat(0.f), splat(0.f)};
        for (int x = 0; x < int(p.stride); x += W) {
            const size_t at = size_t(y) * p.stride + x;
            const vf A = max(load(alpha + at), splat(0.f)), error = load(depth + at) - load(target_depth + at);
            const Mask inside = first_lanes(p.width - x);
            const vf power = o.alpha_power == 0.f ? splat(1.f) : exp2(o.alpha_power * log2(max(A, splat(1e-30f))));
            const vf soft = only(both(inside, in_color(at)), power), on_depth = per_depth * only(both(inside, in_depth(at)), power);
            store(g_sums + 3 * p.plane + at, signed_weight(error, 1.f) * on_depth);
            total[0] += on_depth * abs(error);
            for (int c = 0; c < 3; c++) {
                const vf rendered = load(sums + c * p.plane + at), e = fma(splat(gain), rendered, offset - load(target_color + c * p.plane + at));
                vf on = per_color * soft;
                if (weigh) on *= uncertainty_weight(sums, p, at, c, o, log_median[c]);
                const vf g = signed_weight(e, 1.f) * on;
                store(g_sums + c * p.plane + at, gain * g);
                total[0] += on * abs(e);
                total[1] = fma(gain * g, rendered, total[1]);
                total[2] += g;
            }
        }
        for (int k = 0; k < 3; k++) rows[size_t(y) * 3 + k] = lane_sum(total[k]);
    }
    double sum[3] = {};
    for (int y = 0; y < p.height; y++)
        for (int k = 0; k < 3; k++) sum[k] += rows[size_t(y) * 3 + k];
    for (int c = 0; c < (variance ? 7 : 4); c++)      // padding below the image, and planes without a gradient
        if (c < 4) memset(g_sums + c * p.plane + size_t(p.height) * p.stride, 0, (p.plane - size_t(p.height) * p.stride) * sizeof(float));
        else memset(g_sums + c * p.plane, 0, p.plane * sizeof(float));
    g_exposure[0] = sum[1];
    g_exposure[1] = sum[2];
    return sum[0];
}

// A render as a reference image [height, width]: gray C/A, and depth D/A where A > alpha_above (0 elsewhere). Weights
// at these pixels: of gray, w̃ averaged over the channels; of depth, the same formula with U, the moment about a
// reference depth, if given. Elsewhere the weight is 1, because V has no meaning where the map is thin.
static void reference_maps(const float* sums, const float* alpha, const float* moment, bool variance, Plane p, TrackOptions o,
                           float* gray, float* depth, float* weight_gray, float* weight_depth) {
    static thread_local Selection scratch;
    const auto opaque_at = [&](size_t at) { return gt(load(alpha + at), splat(o.alpha_above)); };
    const auto U = [&](size_t at) { return load(moment + at) + WEIGHT_EPSILON; };
    const auto measured = [&](size_t at) { return both(opaque_at(at), gt(load(moment + at), splat(0.f))); };
    float log_median[3], median_U = 1.f;
    const bool weigh = o.uncertainty && variance && median_log_variance(sums, p, scratch, opaque_at, log_median);
    const bool weigh_depth = moment && lower_median(p, scratch, U, [&](size_t at, vf) { return measured(at); }, &median_U);
    const float log_median_U = log2f(median_U);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < p.height; y++)
        for (int x = 0; x < p.width; x += W) {
            const size_t at = size_t(y) * p.stride + x, to = size_t(y) * p.width + x;
            const vf A = load(alpha + at), inv = 1.f / max(A, splat(0.5f)), one = splat(1.f);
            const Mask opaque = opaque_at(at);
            const vf luma = 0.299f * load(sums + at) + (0.587f * load(sums + p.plane + at) + 0.114f * load(sums + 2 * p.plane + at));
            vf of_gray = splat(0.f), of_depth = one;
            if (weigh) for (int c = 0; c < 3; c++) of_gray += uncertainty_weight(sums, p, at, c, o, log_median[c]);
            if (weigh_depth) of_depth = select(measured(at), confidence(U(at), log_median_U, o), one);
            const vf out[4] = {luma * inv, only(opaque, load(sums + 3 * p.plane + at) * inv),
                               select(opaque, weigh ? of_gray * (1.f / 3.f) : one, one), of_depth};
            float* planes[4] = {gray, depth, weight_gray, weight_depth};
            for (int q = 0; q < 4; q++)
                if (x + W <= p.width) store(planes[q] + to, out[q]);
                else memcpy(planes[q] + to, &out[q], (p.width - x) * sizeof(float));
        }
}
