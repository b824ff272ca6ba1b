// SSIM (Wang et al. 2004): 11×11 Gaussian window, σ 1.5, zero padding, separable; value and gradient in one call. Three
// channels of `height` rows; rows are `stride` floats apart, channels `plane` floats.
constexpr int SSIM_RADIUS = 5, SSIM_PAD = 16;
constexpr float SSIM_C1 = 1e-4f, SSIM_C2 = 9e-4f;

struct Window {
    float weight[2 * SSIM_RADIUS + 1];
    Window() {
        float sum = 0;
        for (int i = 0; i < 11; i++) { const float d = float(i - SSIM_RADIUS); weight[i] = __builtin_expf(-d * d / 4.5f); sum += weight[i]; }
        for (float& w : weight) w /= sum;
    }
};

struct SsimScratch { Buffer<float> rows, fields[6]; };

SIGMA_INLINE vf blur_row(const Window& k, const float* p) {
    vf r = k.weight[SSIM_RADIUS] * load(p);
    for (int d = 1; d <= SSIM_RADIUS; d++) r = fma(splat(k.weight[SSIM_RADIUS + d]), load(p - d) + load(p + d), r);
    return r;
}

// Blur F fields at once: make(field, x) returns W source values of a row; results are written to out[field], in rows of
// `wide` floats.
template <int F, class Make> SIGMA_INLINE void blur_rows(const Window& k, int width, float* padded, size_t pad_stride, float* const* out, Make make) {
    for (int x = 0; x < width; x += W)
        for (int f = 0; f < F; f++) {
            vf v = make(f, x);
            if (x + W > width) v = only(first_lanes(width - x), v);
            store(padded + f * pad_stride + SSIM_PAD + x, v);
        }
    for (int f = 0; f < F; f++)
        for (int x = 0; x < width; x += W) store(out[f] + x, blur_row(k, padded + f * pad_stride + SSIM_PAD + x));
}
template <int F> SIGMA_INLINE void blur_columns(const Window& k, const float* const* in, int row, int height, size_t wide, int x, vf* out) {
    for (int f = 0; f < F; f++) out[f] = splat(0.f);
    const int d0 = row < SSIM_RADIUS ? -row : -SSIM_RADIUS, d1 = height - 1 - row < SSIM_RADIUS ? height - 1 - row : SSIM_RADIUS;
    for (int d = d0; d <= d1; d++)
        for (int f = 0; f < F; f++)
            out[f] = fma(splat(k.weight[d + SSIM_RADIUS]), load(in[f] + ptrdiff_t(row + d) * wide + x), out[f]);
}

SIGMA_INLINE size_t wide_of(int width) { return size_t(width + W - 1) / W * W; }

SIGMA_INLINE vf masked(const float* p, const float* mask, ptrdiff_t at) {
    return mask ? only(gt(load(mask + at), splat(0.f)), load(p + at)) : load(p + at);
}

// The part that depends only on the target: its blurred mean and mean square, 6 planes of height × wide_of(width). With
// a mask, both images are 0 where the mask is not above 0.
static void ssim_target(const float* target, const float* mask, int width, int height, size_t stride, size_t plane, float* cache) {
    static const Window window;
    const size_t wide = wide_of(width), field = wide * height;
    Buffer<float> mean, square;
    mean.reserve(3 * field); square.reserve(3 * field);
#pragma omp parallel
    {
        Buffer<float> padded;
        const size_t pad = wide + 2 * SSIM_PAD;
        padded.reserve(2 * pad);
#pragma omp for schedule(static)
        for (int q = 0; q < 3 * height; q++) {
            const size_t line = size_t(q % height) * stride;
            const float *y = target + q / height * plane + line, *m = mask ? mask + line : nullptr;
            float* out[2] = {mean.data + q * wide, square.data + q * wide};
            blur_rows<2>(window, width, padded.data, pad, out, [&](int f, int x) { const vf v = masked(y, m, x); return f ? v * v : v; });
        }
#pragma omp for schedule(static)
        for (int q = 0; q < 3 * height; q++) {
            const int c = q / height, row = q % height;
            const float* in[2] = {mean.data + c * field, square.data + c * field};
            for (size_t x = 0; x < wide; x += W) {
                vf v[2];
                blur_columns<2>(window, in, row, height, wide, int(x), v);
                store(cache + c * field + row * wide + x, v[0]);
                store(cache + (3 + c) * field + row * wide + x, v[1]);
            }
        }
    }
}

// Return the mean SSIM of image and target. Adds weight · ∂(mean SSIM)/∂image to the gradient where mask (if any) is
// above 0.
static double ssim(const float* image, const float* target, const float* cache, int width, int height, size_t stride,
                   size_t plane, const float* mask, float weight, float* gradient) {
    static const Window window;
    static thread_local SsimScratch scratch;          // each thread that calls has its own
    const size_t wide = wide_of(width), field = wide * height;
    float* f[6];
    for (int i = 0; i < 6; i++) f[i] = scratch.fields[i].reserve(3 * field + W);
    const float scale = weight / (3.f * float(width) * float(height));
    Buffer<double> row_sum;
    row_sum.reserve(3 * height);
#pragma omp parallel
    {
        Buffer<float> padded;
        const size_t pad = wide + 2 * SSIM_PAD;
        padded.reserve(3 * pad);
#pragma omp for schedule(static)
        for (int q = 0; q < 3 * height; q++) {
            const size_t line = size_t(q % height) * stride, at = q / height * plane + line;
            const float *a = image + at, *b = target + at, *on = mask ? mask + line : nullptr;
            float* out[3] = {f[0] + q * wide, f[1] + q * wide, f[2] + q * wide};
            blur_rows<3>(window, width, padded.data, pad, out, [&](int k, int x) {
                const vf v = masked(a, on, x);
                return k == 0 ? v : k == 1 ? v * v : v * load(b + x);
            });
        }
#pragma omp for schedule(static)
        for (int q = 0; q < 3 * height; q++) {
            const int c = q / height, row = q % height;
            const float* in[3] = {f[0] + c * field, f[1] + c * field, f[2] + c * field};
            vf total = splat(0.f);
            for (size_t x = 0; x < wide; x += W) {
                vf v[3];
                blur_columns<3>(window, in, row, height, wide, int(x), v);
                const vf m1 = v[0], m2 = load(cache + c * field + row * wide + x), yy = load(cache + (3 + c) * field + row * wide + x);
                const vf s11 = v[1] - m1 * m1, s22 = yy - m2 * m2, s12 = v[2] - m1 * m2;
                const vf a1 = 2.f * m1 * m2 + SSIM_C1, a2 = 2.f * s12 + SSIM_C2, b1 = m1 * m1 + m2 * m2 + SSIM_C1, b2 = s11 + s22 + SSIM_C2;
                const vf inv = 1.f / (b1 * b2), s = a1 * a2 * inv;
                const Mask inside = first_lanes(width - int(x) < W ? width - int(x) : W);
                total += only(inside, s);
                const vf d11 = -s * b1 * inv, d12 = 2.f * a1 * inv;   // derivatives with respect to E[x²] and E[xy]
                const vf d1 = 2.f * (m2 * a2 - m1 * s * b2) * inv - 2.f * m1 * d11 - m2 * d12;
                store(f[3] + q * wide + x, only(inside, d1));
                store(f[4] + q * wide + x, only(inside, d11));
                store(f[5] + q * wide + x, only(inside, d12));
            }
            row_sum[q] = lane_sum(total);
        }
#pragma omp for schedule(static)
        for (int q = 0; q < 3 * height; q++) {        // the window is symmetric, so it is its own transpose
            float* out[3] = {f[0] + q * wide, f[1] + q * wide, f[2] + q * wide};
            blur_rows<3>(window, width, padded.data, pad, out, [&](int k, int x) { return load(f[3 + k] + q * wide + x); });
        }
#pragma omp for schedule(static)
        for (int q = 0; q < 3 * height; q++) {
            const int c = q / height, row = q % height;
            const float* in[3] = {f[0] + c * field, f[1] + c * field, f[2] + c * field};
            const size_t at = c * plane + size_t(row) * stride;
            for (int x = 0; x < width; x += W) {
                vf v[3];
                blur_columns<3>(window, in, row, height, wide, x, v);
                const vf g = scale * (v[0] + 2.f * load(image + at + x) * v[1] + load(target + at + x) * v[2]);
                Mask on = first_lanes(width - x < W ? width - x : W);
                if (mask) on = both(on, gt(load(mask + size_t(row) * stride + x), splat(0.f)));
                store(gradient + at + x, load(gradient + at + x) + only(on, g));
            }
        }
    }
    double sum = 0;
    for (int q = 0; q < 3 * height; q++) sum += row_sum[q];
    return sum / (3.0 * width * height);
}
