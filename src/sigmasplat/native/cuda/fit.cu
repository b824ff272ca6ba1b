// The loops of the fits on a GPU: the mapping loss with its gradient, SSIM, the shape terms, Adam. fit/losses.py and
// fit/adam.py are the definitions; native/losses.h and native/adam.h are the CPU versions. Planes are [K, H, W],
// exactly of the image's size.
#include "harmonics.cuh"

namespace sigmasplat {

constexpr float NLL_EPSILON = 1e-6f;

inline float signed_weight(float error, float weight) { return error > 0.f ? weight : error < 0.f ? -weight : 0.f; }

// ---- the mapping loss -----------------------------------------------------------------------------------------------

struct LossPlanes {                        // median_depth, moment, alpha and their gradients are null if their weight is 0
    const float *sums, *color, *depth, *median_depth, *moment, *alpha;
    float *on_sums, *on_median_depth, *on_moment, *on_alpha;
    const float* weight;                   // of each reading, 1 on average; may be null
};
struct LossWeights { float l1, depth, nll_color, nll_depth, median_depth, moment, mean_depth; };

// Store, per block, the sums of the weighted terms over valid pixels. All values of every gradient plane are written.
KERNEL mapping_losses(LossPlanes p, int pixels, int variance, float per_pixel, LossWeights weights, double* sums) {
    const int at = thread_number();
    float cost = 0.f;
    if (at < pixels) {
        const float reading = p.depth[at], per_value = per_pixel / 3.f;
        const bool valid = reading > 0.f;
        const float depth = p.sums[3 * size_t(pixels) + at], depth_error = valid ? depth - reading : 0.f;
        const float sure = p.weight ? p.weight[at] : 1.f;
        cost = sure * weights.depth * per_pixel * fabsf(depth_error);
        float on_depth = sure * signed_weight(depth_error, weights.depth * per_pixel);
        if (p.median_depth) {              // both depths get a gradient; median depth 0 = none
            const float median = p.median_depth[at], apart = valid && median > 0.f ? depth - median : 0.f;
            const float pull = signed_weight(apart, weights.median_depth * per_pixel);
            cost += weights.median_depth * per_pixel * fabsf(apart);
            on_depth += pull;
            p.on_median_depth[at] = -pull;
        }
        if (p.moment) {
            const float U = valid ? p.moment[at] : 0.f;
            cost += sure * weights.moment * per_pixel * fabsf(U);
            p.on_moment[at] = sure * signed_weight(U, weights.moment * per_pixel);
        }
        if (p.alpha) {                     // D̂/A; no gradient where A is small
            const float A = p.alpha[at], inverse = 1.f / fmaxf(A, 0.5f), mean = depth * inverse;
            const float off = valid && A > 0.5f ? mean - reading : 0.f;
            const float pull = sure * signed_weight(off, weights.mean_depth * per_pixel) * inverse;
            cost += sure * weights.mean_depth * per_pixel * fabsf(off);
            on_depth += pull;
            p.on_alpha[at] = -pull * mean;
        }
        p.on_sums[3 * size_t(pixels) + at] = on_depth;
        for (int c = 0; c < 3; c++) {
            const float color = p.sums[c * size_t(pixels) + at], error = valid ? color - p.color[c * size_t(pixels) + at] : 0.f;
            float on_color = signed_weight(error, weights.l1 * per_value);
            cost += weights.l1 * per_value * fabsf(error);
            if (variance) {                // ½ r²/(V+ε) + ½ log(V+ε), r detached, V clamped at 0 here only
                const float raw = p.sums[(4 + c) * size_t(pixels) + at] - color * color, v = fmaxf(raw, 0.f) + NLL_EPSILON;
                const float inverse = 1.f / v, log_v = logf(v), color2 = error * error, depth2 = depth_error * depth_error;
                if (valid)
                    cost += 0.5f * per_value * (weights.nll_color * fmaf(color2, inverse, log_v)
                                                + weights.nll_depth * fmaf(depth2, inverse, log_v));
                const float on_v = valid && raw >= 0.f
                    ? 0.5f * per_value * (weights.nll_color * (inverse - color2 * inverse * inverse)
                                          + weights.nll_depth * (inverse - depth2 * inverse * inverse))
                    : 0.f;
                on_color = fmaf(-2.f * color, on_v, on_color);
                p.on_sums[(4 + c) * size_t(pixels) + at] = on_v;
            }
            p.on_sums[c * size_t(pixels) + at] = on_color;
        }
    }
    store_sums<1>(&cost, sums);
}

// ---- SSIM: 11×11 Gaussian; images are 0 outside the border and without a reading ----------------------------------

constexpr int TILE = 16, RADIUS = 5, HALO = TILE + 2 * RADIUS;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
struct Taps { float at[RADIUS + 1]; };     // Gaussian weights from the centre to the edge; the whole window sums to 1

struct Patch { int x, y, channel; };       // a block's first pixel; blocks are numbered by tile, then by channel
inline Patch patch_of_block(int width, int height) {
    const int tiles_x = (width + TILE - 1) / TILE, tiles_y = (height + TILE - 1) / TILE, tile = int(blockIdx.x) % (tiles_x * tiles_y);
    return {tile % tiles_x * TILE, tile / tiles_x * TILE, int(blockIdx.x) / (tiles_x * tiles_y)};
}

// Blur COUNT planes of a patch and its halo along the rows: planes[q][row][column] to rows[q][row][column of the tile].
template <int COUNT> inline void blur_rows(const float* planes, const Taps& taps, float* rows) {
    for (int k = int(threadIdx.x); k < COUNT * HALO * TILE; k += THREADS) {
        const float* from = planes + k / TILE * HALO + k % TILE + RADIUS;
        float sum = taps.at[0] * from[0];
        for (int d = 1; d <= RADIUS; d++) sum = fmaf(taps.at[d], from[-d] + from[d], sum);
        rows[k] = sum;
    }
}
inline float blur_column(const float* rows, const Taps& taps, int x, int y) {   // value of one plane at a pixel of the tile
    const float* from = rows + (y + RADIUS) * TILE + x;
    float sum = taps.at[0] * from[0];
    for (int d = 1; d <= RADIUS; d++) sum = fmaf(taps.at[d], from[-d * TILE] + from[d * TILE], sum);
    return sum;
}

// Store the sum of SSIM over each block's pixels, and its derivatives with respect to the blurred x, x² and x·y: 3
// planes per channel.
KERNEL ssim(const float* image, const float* target, const float* depth, int width, int height, Taps taps, float* derivatives,
            double* sums) {
    __shared__ float planes[5 * HALO * HALO];
    __shared__ float rows[5 * HALO * TILE];
    const Patch patch = patch_of_block(width, height);
    const size_t plane = size_t(width) * height;
    for (int k = int(threadIdx.x); k < HALO * HALO; k += THREADS) {
        const int px = patch.x + k % HALO - RADIUS, py = patch.y + k / HALO - RADIUS;
        const bool inside = px >= 0 && px < width && py >= 0 && py < height;
        const size_t at = inside ? size_t(py) * width + px : 0;
        const bool valid = inside && depth[at] > 0.f;
        const float x = valid ? image[patch.channel * plane + at] : 0.f, y = valid ? target[patch.channel * plane + at] : 0.f;
        planes[k] = x;
        planes[HALO * HALO + k] = y;
        planes[2 * HALO * HALO + k] = x * x;
        planes[3 * HALO * HALO + k] = y * y;
        planes[4 * HALO * HALO + k] = x * y;
    }
    __syncthreads();
    blur_rows<5>(planes, taps, rows);
    __syncthreads();
    const int tx = int(threadIdx.x) % TILE, ty = int(threadIdx.x) / TILE, px = patch.x + tx, py = patch.y + ty;
    float blurred[5], similarity = 0.f;
    for (int q = 0; q < 5; q++) blurred[q] = blur_column(rows + q * HALO * TILE, taps, tx, ty);
    if (px < width && py < height) {
        const float mx = blurred[0], my = blurred[1];
        const float over1 = 1.f / (mx * mx + my * my + C1), over2 = 1.f / (blurred[2] - mx * mx + (blurred[3] - my * my) + C2);
        const float luminance = (2.f * mx * my + C1) * over1, structure = (2.f * (blurred[4] - mx * my) + C2) * over2;
        similarity = luminance * structure;
        const float by_variance = -similarity * over2, by_covariance = 2.f * luminance * over2;
        const float by_mean = 2.f * over1 * (my - luminance * mx) * structure - 2.f * mx * by_variance - my * by_covariance;
        float* to = derivatives + 3 * patch.channel * plane + size_t(py) * width + px;
        to[0] = by_mean;
        to[plane] = by_variance;
        to[2 * plane] = by_covariance;
    }
    store_sums<1>(&similarity, sums);
}

// Add `scale` times the gradient of the summed SSIM to the image's gradient.
KERNEL ssim_backward(const float* image, const float* target, const float* depth, int width, int height, Taps taps,
                     const float* derivatives, float scale, float* on_image) {
    __shared__ float planes[3 * HALO * HALO];
    __shared__ float rows[3 * HALO * TILE];
    const Patch patch = patch_of_block(width, height);
    const size_t plane = size_t(width) * height;
    for (int k = int(threadIdx.x); k < 3 * HALO * HALO; k += THREADS) {
        const int q = k / (HALO * HALO), px = patch.x + k % HALO - RADIUS, py = patch.y + k / HALO % HALO - RADIUS;
        const bool inside = px >= 0 && px < width && py >= 0 && py < height;
        planes[k] = inside ? derivatives[(3 * patch.channel + q) * plane + size_t(py) * width + px] : 0.f;
    }
    __syncthreads();
    blur_rows<3>(planes, taps, rows);
    __syncthreads();
    const int tx = int(threadIdx.x) % TILE, ty = int(threadIdx.x) / TILE, px = patch.x + tx, py = patch.y + ty;
    if (px >= width || py >= height) return;
    const size_t at = size_t(py) * width + px;
    if (!(depth[at] > 0.f)) return;
    const float x = image[patch.channel * plane + at], y = target[patch.channel * plane + at];
    const float by_mean = blur_column(rows, taps, tx, ty), by_square = blur_column(rows + HALO * TILE, taps, tx, ty),
                by_product = blur_column(rows + 2 * HALO * TILE, taps, tx, ty);
    on_image[patch.channel * plane + at] += scale * (by_mean + 2.f * x * by_square + y * by_product);
}

// ---- the splats -----------------------------------------------------------------------------------------------------

// Add the gradient of |s − mean(s)| and of max(s)/min(s) − 1 with respect to log scales to the gradient rows of splats
// in view, and store the cost. Set the colour gradient of the first `frozen` splats to 0. isotropy: weight over 3n;
// ratio: weight, for a mean over `seen` splats.
KERNEL shape_terms(const float* params, const unsigned char* visible, const long long* seen, int n, int frozen, float isotropy, float ratio,
                   float* on_params, double* costs) {
    const int i = thread_number();
    float cost = 0.f;
    if (i < n && visible[i]) {
        const float* row = params + size_t(i) * PARAMS;
        float* on_row = on_params + size_t(i) * PARAMS;
        const float s[3] = {expf(row[7]), expf(row[8]), expf(row[9])}, mean = (s[0] + s[1] + s[2]) / 3.f;
        const float most = fmaxf(fmaxf(s[0], s[1]), s[2]), least = fminf(fminf(s[0], s[1]), s[2]), ratios = ratio / float(*seen);
        float shared = 0.f, mosts = 0.f, leasts = 0.f;
        for (int k = 0; k < 3; k++) {
            cost += isotropy * fabsf(s[k] - mean);
            shared += signed_weight(s[k] - mean, 1.f / 3.f);
            mosts += s[k] == most;
            leasts += s[k] == least;
        }
        cost += ratios * (most / least - 1.f);
        for (int k = 0; k < 3; k++) {      // equal scales share the gradient
            const float apart = (s[k] == most ? 1.f / mosts : 0.f) - (s[k] == least ? 1.f / leasts : 0.f);
            on_row[7 + k] += isotropy * (signed_weight(s[k] - mean, 1.f) - shared) * s[k] + ratios * (most / least) * apart;
        }
        if (i < frozen)
            for (int k = 11; k < 14; k++) on_row[k] = 0.f;
    }
    store_sums<1>(&cost, costs);
}

constexpr int MOST_COLUMNS = 45;           // maximum number of columns that Adam steps
struct Rates { float of[MOST_COLUMNS]; };
struct AdamNumbers { float beta1, beta2, epsilon, unbias1, unbias2; };   // unbias: 1 / (1 − βᵗ) at this step

// Step the rows in view by Adam, one thread per number in the first `used` of `columns` columns. The missed motion of a
// row is added, as in adam_step. Gradient rows contain only the used columns.
KERNEL adam(float* params, float* moment1, float* moment2, const int* last_step, const unsigned char* visible, const float* gradient,
            int numbers, int columns, int used, Rates rates, AdamNumbers a, int step) {
    const int k = thread_number();
    if (k >= numbers || !visible[k / used]) return;
    const int row = k / used, column = k % used, last = last_step[row], missed = step - last - 1;
    const size_t at = size_t(row) * columns + column;
    const float rate = rates.of[column], g = gradient[k], m0 = moment1[at], v0 = moment2[at];
    float value = params[at];
    if (missed > 0 && last > 0) {          // missed motion: each step is r times the one before
        const float r = a.beta1 / sqrtf(a.beta2), steps = r * (1.f - powf(r, float(missed))) / (1.f - r);
        const float m = m0 / (1.f - powf(a.beta1, float(last))), v = v0 / (1.f - powf(a.beta2, float(last)));
        value -= rate * steps * m / (sqrtf(v) + a.epsilon);
    }
    const float m = fmaf(powf(a.beta1, float(missed + 1)), m0, (1.f - a.beta1) * g);
    const float v = fmaf(powf(a.beta2, float(missed + 1)), v0, (1.f - a.beta2) * g * g);
    value -= rate * m * a.unbias1 / (sqrtf(v * a.unbias2) + a.epsilon);
    params[at] = value;
    moment1[at] = m;
    moment2[at] = v;
}

}  // namespace sigmasplat

#include "track.cuh"
