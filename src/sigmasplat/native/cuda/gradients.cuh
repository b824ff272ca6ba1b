// Gradients from pixels to splats. For every (tile, splat) pair, a record of sums over the tile's pixels; then the sum
// of each splat's records in a fixed order; then the chain rule to its shape and to the pose. Included by raster.cu.
// Derivation: docs/kernels.md.
#pragma once

namespace sigmasplat {

// A record: Σ g·{1, x, y, xx, xy, yy}, then Σ w·∂L/∂feature; with a moment Σ w·2·∂L/∂moment and its product with −ref.
// With RAYS, after the features, Σ w·∂L/∂depth·{x, y}; and in a second part, of HALF_WARP sums, those of the moment times
// {1, x, y, xx, xy, yy} and {1, x, y}.
constexpr int MOMENTS = 6, HALF_WARP = 16;
template <int COLORS> constexpr int moment_at = RAYS ? HALF_WARP : MOMENTS + COLORS;
template <int COLORS, bool MOMENT> constexpr int sums_in =
    MOMENT ? moment_at<COLORS> + (RAYS ? 9 : 2) : MOMENTS + COLORS + (RAYS ? 2 : 0);
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
    const float on_square = 2.f * walk.on_moment, by_ref = -on_square * walk.ref;
    float* of_moment = at + moment_at<COLORS> * PIXELS;
    if (RAYS) {
        for (int c = MOMENTS + COLORS; c < HALF_WARP && c < sums_in<COLORS, MOMENT>; c++) at[c * PIXELS] = 0.f;
        for (int c = 0; c < 2; c++) at[(MOMENTS + COLORS + c) * PIXELS] = walk.on_sums[DEPTH] * moments[1 + c];
        if (MOMENT) {
            for (int c = 0; c < MOMENTS; c++) of_moment[c * PIXELS] = on_square * moments[c];
            for (int c = 0; c < 3; c++) of_moment[(MOMENTS + c) * PIXELS] = by_ref * moments[c];
        }
    } else if (MOMENT) {
        of_moment[0] = on_square;
        of_moment[PIXELS] = by_ref;
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
    const float depth = depth_at(row, b, x, y);
    for (int c = 0; c < COLORS; c++) G = fmaf(walk.on_sums[c], feature_at(row, c, depth), G);
    if (MOMENT) {
        const float off = depth - walk.ref;
        G = fmaf(walk.on_moment * off, off, G);
    }
    walk.behind = fmaf(-w, G, walk.behind);
    const float on_alpha = fmaf(walk.light, G, -(walk.behind / (1.f - alpha)));
    on_power = raw < ALPHA_MAX ? on_alpha * alpha : 0.f;
    walk.light = fmaf(-walk.light, alpha, walk.light);
    return true;
}

// Lane c of a warp holds sum c of one record, or of its second part. Move the centre of its moments from the tile's
// centre to the splat's mean, at (u, v) relative to it. one: the lane of a sum whose products with x and y are at `of_x`
// and the next lane, for RAYS.
inline float about_mean(float sum, int c, float u, float v, int one, int of_x) {
    const float whole = RAYS ? __shfl_sync(ALL_LANES, sum, one) : 0.f;
    const float m0 = __shfl_sync(ALL_LANES, sum, 0), mx = __shfl_sync(ALL_LANES, sum, 1), my = __shfl_sync(ALL_LANES, sum, 2);
    if (RAYS && c >= of_x) return c > of_x + 1 ? sum : fmaf(c == of_x ? -u : -v, whole, sum);
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
    for (int first = 0; first < SUMS; first += HALF_WARP) {
        const int c = first + lane % HALF_WARP, column = c < SUMS ? c : 0;
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
        if (first == 0) sum = about_mean(sum, c, u, v, MOMENTS + DEPTH, MOMENTS + COLORS);
        else if (RAYS) sum = about_mean(sum, c - first, u, v, MOMENTS, MOMENTS + 1);
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
            store_about_center(geometry, rows + size_t(items[t]) * ROW + GEOMETRY, corner_x, corner_y, batch + t * STEP);
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
    blend_tile_backward<COUNT, false>(frame, rows, lists, slots, reference, used, o, g, records);
}
KERNEL blend_backward_moment(Frame frame, const float* rows, Lists lists, const long long* slots, const float* reference, int used,
                             Planes o, PlaneGradients g, float* records) {
    blend_tile_backward<COUNT, true>(frame, rows, lists, slots, reference, used, o, g, records);
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
    g.z = g.slope_u = g.slope_v = 0.f;
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

// Add ∂L/∂(depth at the pixels) to a splat's footprint, from the sums of a record about its mean. colors: features with
// gradients. median: ∂L/∂(median depth), alone and times x and y; null = none.
inline void add_depth_gradient(const Footprint<float>& f, const float* m, int colors, int moment, const float* median,
                               FootprintGradient<float>& g) {
    const float* q = m + moment;
    g.z = m[MOMENTS + DEPTH];
    if (median) g.z += median[0];
    if (!RAYS) {
        if (moment) g.z += fmaf(f.z, q[0], q[1]);
        return;
    }
    g.slope_u = m[MOMENTS + colors] + (median ? median[1] : 0.f);
    g.slope_v = m[MOMENTS + colors + 1] + (median ? median[2] : 0.f);
    if (moment) {                          // 2·w·∂L/∂moment·(z + slopes·(x, y) − ref), times 1, x and y
        g.z += fmaf(f.z, q[0], fmaf(f.slope_u, q[1], fmaf(f.slope_v, q[2], q[6])));
        g.slope_u += fmaf(f.z, q[1], fmaf(f.slope_u, q[3], fmaf(f.slope_v, q[4], q[7])));
        g.slope_v += fmaf(f.z, q[2], fmaf(f.slope_u, q[4], fmaf(f.slope_v, q[5], q[8])));
    }
    g.u = fmaf(-f.slope_u, g.z, g.u);
    g.v = fmaf(-f.slope_v, g.z, g.v);
}

// Propagate a splat's summed record to its shape and to the pose.
inline void chain(const View<float>& view, const Splat& s, const float* m, int colors, int moment, const float* median,
                  FootprintGradient<float>& g, ShapeGradient<float>& out) {
    Footprint<float> f = project(view, s.shape, view.near_m);
    if (RAYS) add_slopes(view, s.shape, view.near_m, f);
    g = footprint_gradient(m, f.l1, f.l2, f.l3);
    add_depth_gradient(f, m, colors, moment, median, g);
    project_backward<RAYS>(view, s.shape, view.near_m, g, out);
}

// on_median [n, 3], [n, 1] without RAYS, or null: ∂L/∂(median depth), for one splat per pixel, then times x − u and
// y − v. pull [n] or null: |∂L/∂mean| per half image size.
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
            chain(view, s, m, COUNT, moment, on_median ? on_median + size_t(i) * (RAYS ? 3 : 1) : nullptr, g, out);
            for (int q = 0; q < 6; q++) twist[q] = out.twist[q];
            for (int q = 0; q < 3; q++) row[q] = out.mean[q];
            for (int q = 0; q < 4; q++) row[3 + q] = out.quat[q];
            for (int q = 0; q < 3; q++) row[7 + q] = out.scale[q] * s.shape.scale[q];
            row[10] = m[0] * (1.f - s.opacity);
            for (int q = 0; q < 3; q++) {
                const float on_square = COUNT > 4 ? m[MOMENTS + 4 + q] : 0.f;
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
        chain(posed(view, pose), activated(params, i), sums + size_t(i) * record, 4, 0, nullptr, g, out);
        for (int q = 0; q < 6; q++) twist[q] = out.twist[q];
    }
    store_sums<6>(twist, twists);
}
#endif

}  // namespace sigmasplat
