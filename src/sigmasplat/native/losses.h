// The mapping loss on image planes and its gradient, in one pass; fit/losses.py defines every term. `sums` are planes
// (r, g, b, z[, q, q, q]). A pixel counts if its target depth is above 0. All values of the gradient planes are written
// (0 at pixels that do not count); those of the median depth, of U and of alpha only if given.
constexpr float NLL_EPSILON = 1e-6f;

SIGMA_INLINE vf signed_weight(vf error, float weight) {
    return select(gt(error, splat(0.f)), splat(weight), only(gt(splat(0.f), error), splat(-weight)));
}

static void mapping_losses(const float* sums, const float* target_color, const float* target_depth, int height,
                           size_t stride, size_t plane, bool variance, DepthMaps maps, LossWeights weights, double valid_pixels,
                           float* g_sums, DepthGradients gradients, double* losses) {
    const float per_pixel = float(1.0 / (valid_pixels > 1 ? valid_pixels : 1)), per_value = per_pixel / 3.f;
    Buffer<double> rows;
    rows.reserve(size_t(height) * LOSS_TERMS);
#pragma omp parallel for schedule(static)
    for (int y = 0; y < height; y++) {
        vf total[LOSS_TERMS];
        for (auto& t : total) t = splat(0.f);
        for (size_t x = 0; x < stride; x += W) {
            const size_t at = size_t(y) * stride + x;
            const vf depth = load(target_depth + at), zero = splat(0.f);
            const Mask valid = gt(depth, zero);
            const vf depth_error = only(valid, load(sums + 3 * plane + at) - depth);
            total[1] += abs(depth_error);
            vf g_depth = signed_weight(depth_error, weights.depth * per_pixel);
            if (maps.median_depth) {                  // both depths get a gradient; median depth 0 = none
                const vf median = load(maps.median_depth + at);
                const vf apart = only(both(valid, gt(median, zero)), load(sums + 3 * plane + at) - median);
                const vf g = signed_weight(apart, weights.median_depth * per_pixel);
                total[4] += abs(apart);
                g_depth += g;
                store(gradients.median_depth + at, zero - g);
            }
            if (maps.moment) {
                const vf U = only(valid, load(maps.moment + at));
                total[5] += abs(U);
                store(gradients.moment + at, signed_weight(U, weights.moment * per_pixel));
            }
            if (maps.alpha) {                         // D̂/A; no gradient where A is small
                const vf A = load(maps.alpha + at), half = splat(0.5f), inv = 1.f / max(A, half), mean = load(sums + 3 * plane + at) * inv;
                const vf off = only(both(valid, gt(A, half)), mean - depth);
                const vf g = signed_weight(off, weights.mean_depth * per_pixel) * inv;
                total[6] += abs(off);
                g_depth += g;
                store(gradients.alpha + at, zero - g * mean);
            }
            store(g_sums + 3 * plane + at, g_depth);
            for (int c = 0; c < 3; c++) {
                const vf color = load(sums + c * plane + at), error = only(valid, color - load(target_color + c * plane + at));
                vf g = signed_weight(error, weights.l1 * per_value);
                total[0] += abs(error);
                if (variance) {                       // ½ r²/(V+ε) + ½ log(V+ε), r detached, V clamped at 0 here only
                    const vf raw = load(sums + (4 + c) * plane + at) - color * color, v = max(raw, zero) + NLL_EPSILON;
                    const vf inv = 1.f / v, log_v = log2(v) * 0.6931471805599453f;
                    const vf color2 = error * error, depth2 = depth_error * depth_error;
                    total[2] += only(valid, 0.5f * (color2 * inv + log_v));
                    total[3] += only(valid, 0.5f * (depth2 * inv + log_v));
                    const vf g_v = only(both(valid, ge(raw, zero)),
                                        (weights.nll_color * per_value * 0.5f) * (inv - color2 * inv * inv)
                                        + (weights.nll_depth * per_value * 0.5f) * (inv - depth2 * inv * inv));
                    g = fnma(2.f * color, g_v, g);
                    store(g_sums + (4 + c) * plane + at, g_v);
                }
                store(g_sums + c * plane + at, g);
            }
        }
        for (int k = 0; k < LOSS_TERMS; k++) rows[size_t(y) * LOSS_TERMS + k] = lane_sum(total[k]);
    }
    const double scale[LOSS_TERMS] = {1.0 / 3, 1.0, 1.0 / 3, 1.0 / 3, 1.0, 1.0, 1.0};
    for (int k = 0; k < LOSS_TERMS; k++) {
        losses[k] = 0;
        for (int y = 0; y < height; y++) losses[k] += rows[size_t(y) * LOSS_TERMS + k];
        losses[k] *= scale[k] * per_pixel;
    }
    const auto clear_padding = [&](float* gradient) {   // the rows below the image
        memset(gradient + size_t(height) * stride, 0, (plane - size_t(height) * stride) * sizeof(float));
    };
    for (int c = 0; c < (variance ? 7 : 4); c++) clear_padding(g_sums + c * plane);
    if (maps.median_depth) clear_padding(gradients.median_depth);
    if (maps.moment) clear_padding(gradients.moment);
    if (maps.alpha) clear_padding(gradients.alpha);
}

// |s − mean(s)| summed over the axes of W splats (losses.isotropy; the caller divides by 3n). Returns the sum over
// visible splats, and adds `scale` × its gradient with respect to log scale to three gradient lanes.
SIGMA_INLINE double add_isotropy(const vf* s, Mask seen, float scale, float (*gradient)[W]) {
    const vf mean = (s[0] + s[1] + s[2]) * (1.f / 3.f);
    vf sign[3], total = splat(0.f);
    for (int k = 0; k < 3; k++) {
        sign[k] = signed_weight(s[k] - mean, 1.f);
        total += only(seen, abs(s[k] - mean));
    }
    const vf shared = (sign[0] + sign[1] + sign[2]) * (1.f / 3.f);
    for (int k = 0; k < 3; k++) store(gradient[k], load(gradient[k]) + only(seen, scale * (sign[k] - shared) * s[k]));
    return lane_sum(total);
}

// max(s)/min(s) − 1 summed over W splats (losses.isotropy_ratio; the caller divides by the number of visible splats).
// Like `add_isotropy`.
SIGMA_INLINE double add_isotropy_ratio(const vf* s, Mask seen, float scale, float (*gradient)[W]) {
    const vf most = max(max(s[0], s[1]), s[2]), least = min(min(s[0], s[1]), s[2]), ratio = most / least, one = splat(1.f);
    vf is_most[3], is_least[3], mosts = splat(0.f), leasts = splat(0.f);
    for (int k = 0; k < 3; k++) {                     // equal scales share the gradient
        is_most[k] = only(ge(s[k], most), one);
        is_least[k] = only(ge(least, s[k]), one);
        mosts += is_most[k];
        leasts += is_least[k];
    }
    for (int k = 0; k < 3; k++) {
        const vf pull = scale * ratio * (is_most[k] / mosts - is_least[k] / leasts);
        store(gradient[k], load(gradient[k]) + only(seen, pull));
    }
    return lane_sum(only(seen, ratio - one));
}
