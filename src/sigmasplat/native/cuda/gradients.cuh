// Gradients from pixels to splats. For every (tile, splat) pair, a record of sums over the tile's pixels; then the sum
// of each splat's records in a fixed order; then the chain rule to its shape and to the pose. Included by raster.cu.
// Derivation: docs/kernels.md.
#pragma once

namespace sigmasplat {

// A record: Σ g·{1, x, y, xx, xy, yy}, then Σ w·∂L/∂feature; with a moment Σ w·2·∂L/∂moment and its product with −ref.
constexpr int MOMENTS = 6;
template <int COLORS, bool MOMENT> constexpr int sums_in = MOMENTS + COLORS + (MOMENT ? 2 : 0);
template <int COLORS, bool MOMENT> constexpr int record_floats = (sums_in<COLORS, MOMENT> + 3) / 4 * 4;

struct PlaneGradients { const float *sums, *moment, *alpha; };   // alpha may be null

constexpr int AT_ONCE = 8;                 // splats whose pairs (g, w) are in shared memory together, one per warp
constexpr int PIXELS = THREADS + 4;        // floats between rows of pixels: eight threads read eight banks
constexpr int WEIGHTS = AT_ONCE * PIXELS + 16;   // offset of w relative to g: other banks
constexpr int LOADED = 64;                 // splats copied to shared memory together

// The state of one pixel in the backward pass, near to far: `behind` is Σ w·G over the splats not yet processed.
template <int COLORS, bool MOMENT> struct Walk {
    float on_sums[COLORS], on_alpha, on_moment, ref, light, behind;
};

template <int COLORS, bool MOMENT>
inline Walk<COLORS, MOMENT> walk_at(const Pixel& pixel, const Frame& frame, const float* reference, int used, const Planes& o,
                                    const PlaneGradients& g) {
    const size_t plane = size_t(frame.width) * frame.height;
    Walk<COLORS, MOMENT> walk = {};
    if (!pixel.inside) return walk;
    walk.light = 1.f;
    walk.on_alpha = g.alpha ? g.alpha[pixel.at] : 0.f;
    walk.behind = walk.on_alpha * o.alpha[pixel.at];
    for (int c = 0; c < COLORS; c++) {
        walk.on_sums[c] = c < used ? g.sums[c * plane + pixel.at] : 0.f;
        if (c < used) walk.behind = fmaf(walk.on_sums[c], o.sums[c * plane + pixel.at], walk.behind);
    }
    if (MOMENT) {
        walk.ref = reference[pixel.at];
        walk.on_moment = only(walk.ref > 0.f, g.moment[pixel.at]);
        walk.behind = fmaf(walk.on_moment, o.moment[pixel.at], walk.behind);
    }
    return walk;
}

// The factors of a splat's pair (g, w) at this thread's pixel, one column per sum of the record.
template <int COLORS, bool MOMENT> inline void store_basis(const Walk<COLORS, MOMENT>& walk, float x, float y, float* basis) {
    float* at = basis + threadIdx.x;
    const float moments[MOMENTS] = {1.f, x, y, x * x, x * y, y * y};
    for (int c = 0; c < MOMENTS; c++) at[c * PIXELS] = moments[c];
    for (int c = 0; c < COLORS; c++) at[(MOMENTS + c) * PIXELS] = walk.on_sums[c];
    if (MOMENT) {
        at[(MOMENTS + COLORS) * PIXELS] = 2.f * walk.on_moment;
        at[(MOMENTS + COLORS + 1) * PIXELS] = -2.f * walk.on_moment * walk.ref;
    }
}

// Process one splat: set ∂L/∂power and w; return whether the splat contributes to this pixel.
template <int COLORS, bool MOMENT>
inline bool pass(Walk<COLORS, MOMENT>& walk, const float* row, float x, float y, const Frame& frame, float& on_power, float& w) {
    const float4 a = reinterpret_cast<const float4*>(row)[0], b = reinterpret_cast<const float4*>(row)[1];
    const float power = log_alpha(a, b, x, y);
    on_power = w = 0.f;
    if (!(power >= frame.log_alpha_min && walk.light >= frame.stop)) return false;
    const float raw = exp2f(power), alpha = fminf(raw, ALPHA_MAX);
    w = walk.light * alpha;
    float G = walk.on_alpha;
    for (int c = 0; c < COLORS; c++) G = fmaf(walk.on_sums[c], row[GEOMETRY + c], G);
    if (MOMENT) {
        const float off = b.z - walk.ref;
        G = fmaf(walk.on_moment * off, off, G);
    }
    walk.behind = fmaf(-w, G, walk.behind);
    const float on_alpha = fmaf(walk.light, G, -(walk.behind / (1.f - alpha)));
    on_power = raw < ALPHA_MAX ? on_alpha * alpha : 0.f;
    walk.light = fmaf(-walk.light, alpha, walk.light);
    return true;
}

// Lane c of a warp holds sum c of one record. Move the centre of its moments from the tile's centre to the splat's
// mean, at (u, v) relative to it.
inline float about_mean(float sum, int c, float u, float v) {
    const float m0 = __shfl_sync(ALL_LANES, sum, 0), mx = __shfl_sync(ALL_LANES, sum, 1), my = __shfl_sync(ALL_LANES, sum, 2);
    switch (c) {
        case 1: return fmaf(-u, m0, sum);
        case 2: return fmaf(-v, m0, sum);
        case 3: return fmaf(u, fmaf(u, m0, -2.f * mx), sum);
        case 4: return fmaf(u, fmaf(v, m0, -my), fmaf(-v, mx, sum));
        case 5: return fmaf(v, fmaf(v, m0, -2.f * my), sum);
        default: return sum;
    }
}

// One warp computes one splat's record: lanes 0–15 and 16–31 compute the same sums over one half of every patch's
// pixels each.
template <int COLORS, bool MOMENT>
inline void write_record(const float* pairs, const float* basis, const bool* live, int s, float u, float v, float* record) {
    constexpr int SUMS = sums_in<COLORS, MOMENT>, RECORD = record_floats<COLORS, MOMENT>;
    const int lane = int(threadIdx.x) % 32, half = lane / 16;
    for (int first = 0; first < SUMS; first += 16) {
        const int c = first + lane % 16, column = c < SUMS ? c : 0;
        const float* values = pairs + (column < MOMENTS ? 0 : WEIGHTS) + s * PIXELS + half * 16;
        const float* factors = basis + column * PIXELS + half * 16;
        float4 part = make_float4(0.f, 0.f, 0.f, 0.f);
        for (int patch = 0; patch < PATCHES; patch++) {
            if (!live[s * PATCHES + patch]) continue;
            for (int p = patch * 32; p < patch * 32 + 16; p += 4) {
                const float4 a = *reinterpret_cast<const float4*>(values + p), b = *reinterpret_cast<const float4*>(factors + p);
                part.x = fmaf(a.x, b.x, part.x); part.y = fmaf(a.y, b.y, part.y);
                part.z = fmaf(a.z, b.z, part.z); part.w = fmaf(a.w, b.w, part.w);
            }
        }
        float sum = (part.x + part.y) + (part.z + part.w);
        sum += __shfl_xor_sync(ALL_LANES, sum, 16);
        if (first == 0) sum = about_mean(sum, c, u, v);
        if (half == 0 && c < RECORD) record[c] = c < SUMS ? sum : 0.f;
    }
}

// Process a tile's pixels again. `slots` [pairs]: where to store the record of each listed pair. The first COLORS of a
// row's features have gradients; the others are skipped.
template <int COLORS, bool MOMENT>
inline void blend_tile_backward(const Frame& frame, const float* rows, const Lists& lists, const long long* slots,
                                const float* reference, int used, const Planes& o, const PlaneGradients& g, float* records) {
    constexpr int RECORD = record_floats<COLORS, MOMENT>, QUADS = (COLORS + 3) / 4, STEP = GEOMETRY + 4 * QUADS;
    __shared__ __align__(16) float batch[LOADED * STEP];
    __shared__ __align__(16) float basis[sums_in<COLORS, MOMENT> * PIXELS];
    __shared__ __align__(16) float pairs[WEIGHTS + AT_ONCE * PIXELS];
    __shared__ float2 means[LOADED];       // relative to the tile's centre
    __shared__ unsigned patches[LOADED];
    __shared__ bool live[AT_ONCE * PATCHES];
    const int tile = int(blockIdx.x), t = int(threadIdx.x), patch = t / 32;
    const float corner_x = float(tile % frame.tiles_x * TILE), corner_y = float(tile / frame.tiles_x * TILE);
    const int begin = lists.tile_begin[tile], count = lists.tile_begin[tile + 1] - begin;
    const Pixel pixel = pixel_of_thread(frame);
    Walk<COLORS, MOMENT> walk = walk_at<COLORS, MOMENT>(pixel, frame, reference, used, o, g);
    store_basis(walk, pixel.dx, pixel.dy, basis);
    int first = 0;
    for (; first < count; first += LOADED) {
        if (__syncthreads_and(!pixel.inside || walk.light < frame.stop)) break;
        const int size = count - first < LOADED ? count - first : LOADED;
        const int* items = lists.items + begin + first;
        if (t < size) {
            const Geometry geometry = geometry_at(rows, items[t]);
            patches[t] = patches_reached(geometry, frame, corner_x, corner_y);
            means[t] = make_float2(geometry.u - (corner_x + (TILE - 1) * 0.5f), geometry.v - (corner_y + (TILE - 1) * 0.5f));
            store_about_center(geometry, corner_x, corner_y, batch + t * STEP);
        }
        for (int q = t; q < size * QUADS; q += THREADS) {
            const float4* from = reinterpret_cast<const float4*>(rows + size_t(items[q / QUADS]) * ROW + GEOMETRY);
            reinterpret_cast<float4*>(batch + q / QUADS * STEP + GEOMETRY)[q % QUADS] = from[q % QUADS];
        }
        __syncthreads();
        for (int some = 0; some < size; some += AT_ONCE) {
            const int together = size - some < AT_ONCE ? size - some : AT_ONCE;
            for (int s = 0; s < together; s++) {
                bool anywhere = false;
                if (patches[some + s] >> patch & 1u) {
                    float on_power, w;
                    const bool counts = pass(walk, batch + (some + s) * STEP, pixel.dx, pixel.dy, frame, on_power, w);
                    anywhere = __any_sync(ALL_LANES, counts);
                    if (anywhere) {
                        pairs[s * PIXELS + t] = on_power;
                        pairs[WEIGHTS + s * PIXELS + t] = w;
                    }
                }
                if (t % 32 == 0) live[s * PATCHES + patch] = anywhere;
            }
            __syncthreads();
            if (patch < together)          // here `patch` is a warp's number: it computes that record
                write_record<COLORS, MOMENT>(pairs, basis, live, patch, means[some + patch].x, means[some + patch].y,
                                             records + size_t(slots[begin + first + some + patch]) * RECORD);
            __syncthreads();
        }
    }
    for (int k = first * RECORD + t; k < count * RECORD; k += THREADS)   // no gradient behind opaque splats
        records[size_t(slots[begin + k / RECORD]) * RECORD + k % RECORD] = 0.f;
}

KERNEL blend_backward(Frame frame, const float* rows, Lists lists, const long long* slots, const float* reference, int used, Planes o,
                      PlaneGradients g, float* records) {
    blend_tile_backward<FEATURES, false>(frame, rows, lists, slots, reference, used, o, g, records);
}
KERNEL blend_backward_moment(Frame frame, const float* rows, Lists lists, const long long* slots, const float* reference, int used,
                             Planes o, PlaneGradients g, float* records) {
    blend_tile_backward<FEATURES, true>(frame, rows, lists, slots, reference, used, o, g, records);
}

// Sum each splat's records, which are contiguous, in order, with one thread per sum and splat. There must be fewer than
// 2³² such sums, because 64-bit divisions take several times as long.
KERNEL sum_records(const float* records, const int* first_slots, const int* counts, int n, int record, float* sums) {
    const unsigned k = unsigned(blockIdx.x) * THREADS + unsigned(threadIdx.x), width = unsigned(record);
    const unsigned i = k / width, c = k - i * width;
    if (i >= unsigned(n)) return;
    float sum = 0.f;
    if (counts[i]) {
        const float* from = records + size_t(first_slots[i]) * record + c;
        for (int q = 0; q < counts[i]; q++) sum += from[size_t(q) * record];
    }
    sums[k] = sum;
}

// ∂L/∂(mean, conic) from moments of ∂L/∂power about the mean: power = −½(p² + q²), p = l1·x + l2·y, q = l3·y.
inline FootprintGradient<float> footprint_gradient(const float* m, float l1, float l2, float l3) {
    FootprintGradient<float> g;
    const float p = l1 * m[1] + l2 * m[2];
    g.u = l1 * p;
    g.v = l2 * p + l3 * l3 * m[2];
    g.l1 = -(l1 * m[3] + l2 * m[4]);
    g.l2 = -(l1 * m[4] + l2 * m[5]);
    g.l3 = -l3 * m[5];
    g.z = 0.f;
    return g;
}

// moment: position in a record of the two sums about the reference depth, 0 = none.
KERNEL chain_given(const float* conics, const float* z, const float* opacities, const int* counts, const float* sums, int n, int used,
                   int record, int moment, float* on_means2d, float* on_conics, float* on_z, float* on_opacities, float* on_features) {
    const int i = thread_number();
    if (i >= n) return;
    const bool seen = counts[i] > 0;
    const float *m = sums + size_t(i) * record, *l = conics + 3 * size_t(i);
    const FootprintGradient<float> g = footprint_gradient(m, l[0], l[1], l[2]);
    on_means2d[2 * size_t(i)] = only(seen, g.u); on_means2d[2 * size_t(i) + 1] = only(seen, g.v);
    on_conics[3 * size_t(i)] = only(seen, g.l1); on_conics[3 * size_t(i) + 1] = only(seen, g.l2); on_conics[3 * size_t(i) + 2] = only(seen, g.l3);
    on_z[i] = seen && moment ? fmaf(z[i], m[moment], m[moment + 1]) : 0.f;
    on_opacities[i] = seen ? m[0] / opacities[i] : 0.f;
    for (int c = 0; c < used; c++) on_features[size_t(i) * used + c] = only(seen, m[MOMENTS + c]);
}

KERNEL project_splats_backward(View<float> view, const float* pose, const float* means, const float* quats, const float* scales,
                               const float* radii, const float* on_means2d, const float* on_conics, const float* on_z, int n,
                               float* on_means, float* on_quats, float* on_scales, double* twists) {
    const int i = thread_number();
    float twist[6] = {};
    if (i < n) {
        view = posed(view, pose);
        const bool seen = radii[2 * size_t(i)] > 0.f;
        const FootprintGradient<float> g = {on_means2d[2 * size_t(i)], on_means2d[2 * size_t(i) + 1], on_z[i], on_conics[3 * size_t(i)],
                                            on_conics[3 * size_t(i) + 1], on_conics[3 * size_t(i) + 2], 0.f, 0.f};
        ShapeGradient<float> out;
        project_backward(view, shape_at(means, quats, scales, i), view.near_m, g, out);
        for (int k = 0; k < 6; k++) twist[k] = only(seen, out.twist[k]);
        for (int k = 0; k < 3; k++) on_means[3 * size_t(i) + k] = only(seen, out.mean[k]);
        for (int k = 0; k < 4; k++) on_quats[4 * size_t(i) + k] = only(seen, out.quat[k]);
        for (int k = 0; k < 3; k++) on_scales[3 * size_t(i) + k] = only(seen, out.scale[k]);
    }
    store_sums<6>(twist, twists);
}

#if FEATURES <= 7
KERNEL blend_backward_pose(Frame frame, const float* rows, Lists lists, const long long* slots, int used, Planes o, PlaneGradients g,
                           float* records) {
    blend_tile_backward<4, false>(frame, rows, lists, slots, nullptr, used, o, g, records);
}

// Propagate a splat's summed record to its shape and to the pose.
inline void chain(const View<float>& view, const Splat& s, const float* m, int moment, float on_median, FootprintGradient<float>& g,
                  ShapeGradient<float>& out) {
    const Footprint<float> f = project(view, s.shape, view.near_m);
    g = footprint_gradient(m, f.l1, f.l2, f.l3);
    g.z = m[MOMENTS + 3] + on_median;
    if (moment) g.z += fmaf(f.z, m[moment], m[moment + 1]);
    project_backward(view, s.shape, view.near_m, g, out);
}

// on_median [n] or null: ∂L/∂(median depth), for one splat per pixel. pull [n] or null: |∂L/∂mean| per half image size.
KERNEL chain_params(View<float> view, const float* pose, const float* params, const int* counts, const float* sums,
                    const float* on_median, int n, int record, int moment, float* on_params, float* pull, double* twists) {
    const int i = thread_number();
    float twist[6] = {};
    if (i < n) {
        float* row = on_params + size_t(i) * PARAMS;
        if (counts[i]) {
            view = posed(view, pose);
            const Splat s = activated(params, i);
            const float* m = sums + size_t(i) * record;
            FootprintGradient<float> g;
            ShapeGradient<float> out;
            chain(view, s, m, moment, on_median ? on_median[i] : 0.f, g, out);
            for (int q = 0; q < 6; q++) twist[q] = out.twist[q];
            for (int q = 0; q < 3; q++) row[q] = out.mean[q];
            for (int q = 0; q < 4; q++) row[3 + q] = out.quat[q];
            for (int q = 0; q < 3; q++) row[7 + q] = out.scale[q] * s.shape.scale[q];
            row[10] = m[0] * (1.f - s.opacity);
            for (int q = 0; q < 3; q++) {
                const float on_square = FEATURES > 4 ? m[MOMENTS + 4 + q] : 0.f;
                row[11 + q] = fmaf(2.f * s.color[q], on_square, m[MOMENTS + q]);
                row[14 + q] = on_square * s.variance[q];
            }
            const float u = 0.5f * view.width * g.u, v = 0.5f * view.height * g.v;
            if (pull) pull[i] = sqrtf(fmaf(u, u, v * v));
        } else {
            for (int q = 0; q < PARAMS; q++) row[q] = 0.f;
            if (pull) pull[i] = 0.f;
        }
    }
    store_sums<6>(twist, twists);
}

KERNEL chain_pose(View<float> view, const float* pose, const float* params, const int* counts, const float* sums, int n, int record,
                  double* twists) {
    const int i = thread_number();
    float twist[6] = {};
    if (i < n && counts[i]) {
        FootprintGradient<float> g;
        ShapeGradient<float> out;
        chain(posed(view, pose), activated(params, i), sums + size_t(i) * record, 0, 0.f, g, out);
        for (int q = 0; q < 6; q++) twist[q] = out.twist[q];
    }
    store_sums<6>(twist, twists);
}
#endif

}  // namespace sigmasplat
