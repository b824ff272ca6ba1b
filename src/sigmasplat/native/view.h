// Stages 1–3 together: the two operators `project` and `blend`, and the fused path from raw parameter rows to images
// and back.

// Call f(slopes): which depth of views is compiled in.
template <class F> SIGMA_INLINE void with_depth(const BlendOptions& o, F f) { o.ray_depth ? f(std_int<1>{}) : f(std_int<0>{}); }

static void blend(Render& r, Outputs o) {
    with_features(r.k, [&](auto k) {
        constexpr int K = decltype(k)::value;
        const auto maps = [&](auto slopes) {
            constexpr bool SLOPES = decltype(slopes)::value != 0;
            if (o.moment) o.dominant_id ? blend_tiles<K, true, true, SLOPES>(r, o) : blend_tiles<K, true, false, SLOPES>(r, o);
            else o.dominant_id ? blend_tiles<K, false, true, SLOPES>(r, o) : blend_tiles<K, false, false, SLOPES>(r, o);
        };
        if constexpr (K <= 7) with_depth(r.options, maps);
        else maps(std_int<0>{});
    });
}
static void blend_gradients(Render& r, OutputGradients g) {   // to each splat's slots
    with_features(r.k, [&](auto k) {
        constexpr int K = decltype(k)::value;
        const auto to_slots = [&](auto moment, auto slopes) {
            constexpr bool MOMENT = decltype(moment)::value != 0, SLOPES = decltype(slopes)::value != 0;
            r.partials.reserve(size_t(r.intersections + 1) * record_floats<K, MOMENT, SLOPES>);
            blend_tiles_backward<K, K, MOMENT, SLOPES>(
                r, g, [&](Scratch& s, const Tile& tile) { flush_records<K, MOMENT, SLOPES>(r, s, tile); });
        };
        const auto any_moment = [&](auto slopes) { g.moment ? to_slots(std_int<1>{}, slopes) : to_slots(std_int<0>{}, slopes); };
        if constexpr (K <= 7) with_depth(r.options, any_moment);
        else any_moment(std_int<0>{});
    });
}

// ---- the operators: blend on its own -------------------------------------------------------------------------------

template <int K> static void pack_given(Render& r, const float* means2d, const float* conics, const float* z, const float* radii,
                                        const float* opacities, const float* features, int k) {
    const int64_t n = r.n, chunks = (n + CHUNK - 1) / CHUNK;
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; c++) {
        int total = 0;
        for (int64_t i = c * CHUNK; i < n && i < (c + 1) * CHUNK; i += W) {
            alignas(64) float t[3][W], lanes[16][W] = {};
            Footprint<vf> f;
            load_rows<2>(means2d, i, n, t);
            f.u = load(t[0]); f.v = load(t[1]);
            load_rows<3>(conics, i, n, t);
            f.l1 = load(t[0]); f.l2 = load(t[1]); f.l3 = load(t[2]);
            f.var_v = 1.f / (f.l3 * f.l3);
            f.var_u = (f.l2 * f.l2 * f.var_v + 1.f) / (f.l1 * f.l1);
            load_rows<1>(z, i, n, t);
            f.z = load(t[0]);
            load_rows<1>(opacities, i, n, t);
            const vf opacity = load(t[0]);
            load_rows<2>(radii, i, n, t);
            for (int l = 0; l < W && i + l < n; l++)
                for (int q = 0; q < k; q++) lanes[q][l] = features[size_t(i + l) * k + q];
            total += pack<row_floats<K>>(r, f, opacity, gt(load(t[0]), splat(0.f)), i, total, lanes, [](unsigned) {});
        }
        r.chunk_begin[c] = total;
    }
}

static void blend_forward(Context* context, const float* means2d, const float* conics, const float* z, const float* radii,
                          const float* opacities, const float* features, int64_t n, int k, int width, int height,
                          const float* reference, BlendOptions options, Outputs o) {
    Render& r = *reinterpret_cast<Render*>(context);
    r.prepare(n, k, width, height, options);
    r.reference = reference;
    with_features(r.k, [&](auto slots) {
        pack_given<decltype(slots)::value>(r, means2d, conics, z, radii, opacities, features, k);
    });
    bin(r);
    blend(r, o);
}

static void blend_backward(Context* context, OutputGradients g, SplatGradients out) {
    Render& r = *reinterpret_cast<Render*>(context);
    blend_gradients(r, g);
    with_features(r.k, [&](auto k) {
        constexpr int K = decltype(k)::value;
        const auto finish = [&](auto record, auto moment) {
            const int64_t chunks = (r.n + CHUNK - 1) / CHUNK;
#pragma omp parallel for schedule(static)
            for (int64_t chunk = 0; chunk < chunks; chunk++) {
              int slot = r.chunk_begin[chunk];
              for (int64_t i = chunk * CHUNK; i < r.n && i < (chunk + 1) * CHUNK; i += W) {
                alignas(64) float sums[decltype(record)::value][W], t[3][W], l[8][W];
                reduce_records<decltype(record)::value>(r, i, slot, sums);
                for (int q = 0; q < W; q++) {         // unseen splats have no geometry: any finite conic is correct
                    const bool seen = i + q < r.n && r.tiles_of[i + q];
                    const Geometry g0 = seen ? r.geometry(i + q) : Geometry{1, 0, 1, 0, 0, 0, 1, 0};
                    l[0][q] = g0.l1 / CONIC_SCALE; l[1][q] = g0.l2 / CONIC_SCALE; l[2][q] = g0.l3 / CONIC_SCALE;
                    l[3][q] = g0.z; l[4][q] = seen ? exp2f(g0.log_opacity) : 1.f;
                }
                FootprintGradient<vf> f = footprint_gradient(moments_of(sums), load(l[0]), load(l[1]), load(l[2]));
                if constexpr (decltype(moment)::value) f.z = fma(load(l[3]), weight_sum(sums, K), weight_sum(sums, K + 1));
                store(t[0], f.u); store(t[1], f.v);
                store_rows<2>(out.means2d, i, r.n, t);
                store(t[0], f.l1); store(t[1], f.l2); store(t[2], f.l3);
                store_rows<3>(out.conics, i, r.n, t);
                store(t[0], f.z);
                store_rows<1>(out.z, i, r.n, t);
                store(t[0], load(sums[0]) / load(l[4]));
                store_rows<1>(out.opacities, i, r.n, t);
                for (int c = 0; c < K && c < r.used; c++) {
                    alignas(64) float lane[W];
                    store(lane, weight_sum(sums, c));
                    for (int q = 0; q < W && i + q < r.n; q++) out.features[size_t(i + q) * r.used + c] = lane[q];
                }
              }
            }
        };
        g.moment ? finish(std_int<record_floats<K, true>>{}, std_int<1>{}) : finish(std_int<record_floats<K, false>>{}, std_int<0>{});
    });
}

// ---- fused: rows of raw parameters to images and back ----------------------------------------------------------------

struct Splats { Shape<vf> shape; vf opacity, color[3], variance[3]; };

template <bool VARIANCE> SIGMA_INLINE Splats activate(const float (*row)[W]) {   // GaussianField's columns, activated
    Splats s;
    for (int k = 0; k < 3; k++) s.shape.mean[k] = load(row[k]);
    for (int k = 0; k < 4; k++) s.shape.quat[k] = load(row[3 + k]);
    for (int k = 0; k < 3; k++) s.shape.scale[k] = exp(load(row[7 + k]));
    s.opacity = 1.f / (1.f + exp(-load(row[10])));
    for (int k = 0; k < 3; k++) s.color[k] = load(row[11 + k]);
    for (int k = 0; k < 3; k++) s.variance[k] = VARIANCE ? exp(load(row[14 + k])) : splat(0.f);
    return s;
}

template <int K> static void pack_view(Render& r, const float* params, const ViewColors& colors) {
    const int64_t n = r.n, chunks = (n + CHUNK - 1) / CHUNK;
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; c++) {
        int total = 0;
        for (int64_t i = c * CHUNK; i < n && i < (c + 1) * CHUNK; i += W) {
            alignas(64) float row[ROW][W], f[8][W];
            load_rows<ROW>(params, i, n, row);
            for (int l = 0; l <= W; l++) __builtin_prefetch(params + (i + 2 * W + l) * ROW);
            Splats s = activate<(K > 4)>(row);
            Footprint<vf> p = project(r.view, s.shape, splat(r.view.near_m));
            if (r.options.ray_depth) add_slopes_to(r.view, s.shape, p);
            const auto fill = [&](unsigned live) {
                if (colors.degree) {
                    alignas(64) float harmonics[HARMONICS][W];
                    prefetch_harmonics(colors.harmonics, colors.degree, i + W, n, [](int64_t) { return true; });
                    show_colors(r.view, colors, i, live, s.shape.mean, s.color, harmonics);
                }
                for (int q = 0; q < 3; q++) store(f[q], s.color[q]);
                store(f[3], r.options.ray_depth ? p.slope_u : p.z);
                for (int q = 0; q < 3; q++) store(f[4 + q], K > 4 ? fma(s.color[q], s.color[q], s.variance[q]) : splat(0.f));
                store(f[7], r.options.ray_depth ? p.slope_v : splat(0.f));
            };
            total += pack<row_floats<K>>(r, p, s.opacity, gt(p.z, splat(r.view.near_m)), i, total, f, fill);
        }
        r.chunk_begin[c] = total;
    }
}

static void view_forward(Context* context, const float* view_numbers, const float* params, ViewColors colors, int64_t n, int k,
                         const float* reference, BlendOptions options, Outputs o, double* seconds) {
    Render& r = *reinterpret_cast<Render*>(context);
    const double t0 = omp_get_wtime();
    r.view = read_view(view_numbers);
    r.prepare(n, k, int(r.view.width), int(r.view.height), options);
    r.reference = reference;
    k <= 4 ? pack_view<4>(r, params, colors) : pack_view<7>(r, params, colors);
    const double t1 = omp_get_wtime();
    bin(r);
    const double t2 = omp_get_wtime();
    blend(r, o);
    if (seconds) { seconds[0] += t1 - t0; seconds[1] += t2 - t1; seconds[2] += omp_get_wtime() - t2; }
}

// Add ∂L/∂(median depth) of each pixel to the depth of one splat, and to its slopes if rows hold them, in the order of
// the pixels, so that sums do not depend on threads.
static const float* gather_median(Render& r, OutputGradients g) {
    if (!g.median_depth) return nullptr;
    const size_t splats = size_t(r.n) + W, numbers = (r.options.ray_depth ? 3 : 1) * splats;
    float* sums = r.median_gradient.reserve(numbers);
    memset(sums, 0, numbers * sizeof(float));
    const size_t stride = r.padded_width();
    for (int y = 0; y < r.height; y++)
        for (int x = 0; x < r.width; x++) {
            const size_t at = size_t(y) * stride + x;
            const int id = g.median_id[at];
            if (id < 0) continue;
            sums[id] += g.median_depth[at];
            if (!r.options.ray_depth) continue;
            const Geometry& splat = r.geometry(id);
            sums[splats + id] += g.median_depth[at] * (float(x) - splat.u);
            sums[2 * splats + id] += g.median_depth[at] * (float(y) - splat.v);
        }
    return sums;
}

// Propagate the summed records of all splats to the pose twist and to parameter rows. If any of W splats is seen,
// `sink(i, seen, splats, gradient lanes, harmonics lanes)` receives ∂L/∂params, where the colours are those seen from this
// view; otherwise `unseen(i)` is called. g_median: result of `gather_median`. pull [n], or null: |∂L/∂mean| in the image, per half image size, 0 for unseen splats.
template <int K, bool MOMENT, bool SLOPES, class Sink, class Unseen>
static void chain_to_params(const Render& r, const float* params, const ViewColors& colors, const float* g_median, float* pull,
                            double* g_twist, Sink sink, Unseen unseen) {
    constexpr int RECORD = record_floats<K, MOMENT, SLOPES>;
    constexpr bool PACKED = is_packed<K, MOMENT, SLOPES>;
    const float half_width = 0.5f * float(r.width), half_height = 0.5f * float(r.height);
    if (pull) memset(pull, 0, size_t(r.n) * sizeof(float));
    const int64_t chunks = (r.n + CHUNK - 1) / CHUNK;
    Buffer<double> partial;
    partial.reserve(chunks * 6 + 1);
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; c++) {
        vf twist[6];
        for (auto& x : twist) x = splat(0.f);
        int slot = r.chunk_begin[c];
        for (int64_t i = c * CHUNK; i < r.n && i < (c + 1) * CHUNK; i += W) {
            unsigned seen_bits = 0;
            for (int l = 0; l < W && i + l < r.n; l++) seen_bits |= unsigned(r.tiles_of[i + l] > 0) << l;
            if (!seen_bits) { unseen(i); continue; }
            alignas(64) float row[ROW][W], sums[RECORD][W], gradient[ROW][W], harmonics[HARMONICS][W];
            const Mask seen = mask_of_bits(seen_bits);
            load_rows<ROW>(params, i, r.n, row);
            reduce_records<RECORD>(r, i, slot, sums);
            Splats s = activate<(K > 4)>(row);
            if (colors.degree) show_colors(r.view, colors, i, seen_bits, s.shape.mean, s.color, harmonics);
            Footprint<vf> p = project(r.view, s.shape, splat(r.view.near_m));
            if constexpr (SLOPES) add_slopes_to(r.view, s.shape, p);
            FootprintGradient<vf> g = footprint_gradient(moments_of<PACKED>(sums), p.l1, p.l2, p.l3);
            if constexpr (SLOPES) {
                add_depth_gradient<K, MOMENT>(sums, p, g);
                if (g_median) {
                    const vf on_depth = load(g_median + i);
                    g.z += on_depth;
                    g.slope_u += load(g_median + r.n + W + i);
                    g.slope_v += load(g_median + 2 * (r.n + W) + i);
                    g.u = fnma(p.slope_u, on_depth, g.u);
                    g.v = fnma(p.slope_v, on_depth, g.v);
                }
            } else {
                g.z = weight_sum<PACKED>(sums, 3);
                if constexpr (MOMENT) g.z += fma(p.z, weight_sum<PACKED>(sums, K), weight_sum<PACKED>(sums, K + 1));
                if (g_median) g.z += load(g_median + i);
            }
            if (pull) {
                alignas(64) float lanes[W];
                const vf u = half_width * g.u, v = half_height * g.v;
                store(lanes, only(seen, sqrt(fma(u, u, v * v))));
                for (int l = 0; l < W && i + l < r.n; l++) pull[i + l] = lanes[l];
            }
            ShapeGradient<vf> out;
            project_backward<SLOPES>(r.view, s.shape, splat(r.view.near_m), g, out);
            for (int q = 0; q < 6; q++) twist[q] += only(seen, out.twist[q]);
            for (int q = 0; q < 3; q++) store(gradient[q], only(seen, out.mean[q]));
            for (int q = 0; q < 4; q++) store(gradient[3 + q], only(seen, out.quat[q]));
            for (int q = 0; q < 3; q++) store(gradient[7 + q], only(seen, out.scale[q] * s.shape.scale[q]));
            store(gradient[10], only(seen, load(sums[0]) * (1.f - s.opacity)));
            for (int q = 0; q < 3; q++) {
                vf g_square = splat(0.f);
                if constexpr (K > 4) g_square = weight_sum<PACKED>(sums, 4 + q);
                store(gradient[11 + q], only(seen, fma(2.f * s.color[q], g_square, weight_sum<PACKED>(sums, q))));
                store(gradient[14 + q], only(seen, g_square * s.variance[q]));
            }
            sink(i, seen_bits, s, gradient, harmonics);
        }
        for (int q = 0; q < 6; q++) partial[c * 6 + q] = lane_sum(twist[q]);
    }
    for (int q = 0; q < 6; q++) {
        g_twist[q] = 0;
        for (int64_t c = 0; c < chunks; c++) g_twist[q] += partial[c * 6 + q];
    }
}
template <class Sink, class Unseen>
static void chain_any(Render& r, const float* params, const ViewColors& colors, OutputGradients g, float* pull, double* g_twist, Sink sink,
                      Unseen unseen) {
    const float* g_median = gather_median(r, g);
    const auto chain = [&](auto k, auto slopes) {
        constexpr int K = decltype(k)::value;
        constexpr bool SLOPES = decltype(slopes)::value != 0;
        g.moment ? chain_to_params<K, true, SLOPES>(r, params, colors, g_median, pull, g_twist, sink, unseen)
                 : chain_to_params<K, false, SLOPES>(r, params, colors, g_median, pull, g_twist, sink, unseen);
    };
    with_depth(r.options, [&](auto slopes) { r.k <= 4 ? chain(std_int<4>{}, slopes) : chain(std_int<7>{}, slopes); });
}

static void view_backward(Context* context, const float* params, OutputGradients g, float* g_params, float* pull,
                          double* g_twist, double* seconds) {
    Render& r = *reinterpret_cast<Render*>(context);
    const double t0 = omp_get_wtime();
    blend_gradients(r, g);
    const double t1 = omp_get_wtime();
    chain_any(r, params, {}, g, pull, g_twist,
        [&](int64_t i, unsigned, const Splats&, const float (*gradient)[W], const float (*)[W]) { store_rows<ROW>(g_params, i, r.n, gradient); },
        [&](int64_t i) { memset(g_params + i * ROW, 0, size_t(r.n - i < W ? r.n - i : W) * ROW * sizeof(float)); });
    if (seconds) { seconds[0] += t1 - t0; seconds[1] += omp_get_wtime() - t1; }
}

// Backward pass and one Adam step together, so that no gradient row is written to memory. Splats out of view are not
// stepped now (adam.h), and have no isotropy term: |s − mean(s)| is a mean over all splats, max(s)/min(s) − 1 over
// those in view. Returns the weighted cost of both.
static double view_step(Context* context, float* params, OutputGradients g, AdamState state, AdamOptions options,
                        StepOptions terms, HarmonicsStep harmonics, float* pull, double* g_twist, double* seconds) {
    Render& r = *reinterpret_cast<Render*>(context);
    const double t0 = omp_get_wtime();
    blend_gradients(r, g);
    const double t1 = omp_get_wtime();
    const AdamRates adam(options);
    const AdamStep adam_harmonics(options, harmonics.step);
    int64_t visible = 0;
    if (terms.isotropy_ratio > 0.f)
        for (int64_t i = 0; i < r.n; i++) visible += r.tiles_of[i] > 0;
    const float scale = terms.isotropy / (3.f * float(r.n > 0 ? r.n : 1)), scale_ratio = terms.isotropy_ratio / float(visible > 0 ? visible : 1);
    Buffer<double> cost;
    cost.reserve(r.n / W + 1);                        // zero where nothing is seen
    Buffer<float> moved;                              // gradient of W means through the colours
    if (harmonics.degree) moved.reserve((r.n / W + 1) * 3);
    chain_any(r, params, {harmonics.params, harmonics.degree}, g, pull, g_twist,
        [&](int64_t i, unsigned seen, const Splats& s, float (*gradient)[W], float (*lanes)[W]) {
            cost[i / W] = double(scale) * add_isotropy(s.shape.scale, mask_of_bits(seen), scale, gradient + 7);
            if (terms.isotropy_ratio > 0.f)
                cost[i / W] += double(scale_ratio) * add_isotropy_ratio(s.shape.scale, mask_of_bits(seen), scale_ratio, gradient + 7);
            for (int64_t l = 0; l < W && i + l < terms.frozen_colors; l++)
                for (int q = 11; q < 14; q++) gradient[q][l] = 0.f;
            if (harmonics.degree) {
                for (const float* rows : {harmonics.params, harmonics.state.moment1, harmonics.state.moment2})
                    prefetch_harmonics(rows, harmonics.degree, i + W, r.n, [&](int64_t l) { return r.tiles_of[l] > 0; });
                vf on_mean[3];
                step_harmonics(r.view, harmonics, adam_harmonics, i, seen, s.shape.mean, gradient, lanes, on_mean);
                for (int q = 0; q < 3; q++) moved[i / W * 3 + q] = lane_sum(on_mean[q]);
            }
            adam_rows(adam, params, state, i, r.n, seen, gradient);
        },
        [](int64_t) {});
    double sum = 0;
    for (int64_t i = 0; i * W < r.n; i++) sum += cost[i];
    if (harmonics.degree)                             // a camera motion ρ acts like a splat motion −ρ
        for (int q = 0; q < 3; q++) {
            double on_mean = 0;
            for (int64_t i = 0; i * W < r.n; i++) on_mean += moved[i * 3 + q];
            for (int d = 0; d < 3; d++) g_twist[d] += r.view.R[3 * d + q] * on_mean;
        }
    if (seconds) { seconds[0] += t1 - t0; seconds[1] += omp_get_wtime() - t1; }
    return sum;
}

// Only ∂L/∂pose, from gradients on colour and depth. It is accumulated per tile; no gradient of a splat is stored.
static void view_backward_pose(Context* context, const float* params, OutputGradients g, double* g_twist, double* seconds) {
    Render& r = *reinterpret_cast<Render*>(context);
    const double t0 = omp_get_wtime();
    const int tiles = r.tiles_x * r.tiles_y;
    Buffer<double> partial;
    partial.reserve(size_t(tiles) * 6);
    const auto finish = [&](auto slopes, Scratch& scratch, const Tile& tile) {
        constexpr bool SLOPES = decltype(slopes)::value != 0;
        const uint64_t* items = r.items.data + r.tile_begin[tile.index];
        vf twist[6];
        for (auto& x : twist) x = splat(0.f);
        for (int k = 0; k < tile.count; k += W) {
            alignas(64) float row[ROW][W], sums[16][W], center[2][W];
            const float* rows[W];
            const int count = tile.count - k < W ? tile.count - k : W;
            for (int l = k + W; l < k + 2 * W && l < tile.count; l++) __builtin_prefetch(params + size_t(uint32_t(items[l])) * ROW);
            for (int l = 0; l < W; l++) rows[l] = params + size_t(uint32_t(items[k + (l < count ? l : 0)])) * ROW;
            turn_rows<ROW>(rows, row);
            load_rows<2>(&scratch.centers[0].u, k, tile.count, center);
            load_rows<16>(scratch.records.data, k, tile.count, sums);
            Moments a = moments_of(sums);
            shift_moments(a.m[0], a.m[1], a.m[2], a.m[3], a.m[4], a.m[5], load(center[0]), load(center[1]));
            const Splats s = activate<false>(row);
            Footprint<vf> p = project(r.view, s.shape, splat(r.view.near_m));
            if constexpr (SLOPES) add_slopes_to(r.view, s.shape, p);
            FootprintGradient<vf> f = footprint_gradient(a, p.l1, p.l2, p.l3);
            if constexpr (SLOPES) {
                vf weighed[6];
                for (int c = 3; c < 6; c++) weighed[c] = weight_sum(sums, c);
                shift_depth_sums<4, false>([&](int c) -> vf& { return weighed[c]; }, load(center[0]), load(center[1]));
                for (int c = 3; c < 6; c++) store(sums[weight_place(c)], weighed[c]);
                add_depth_gradient<4, false>(sums, p, f);
            } else {
                f.z = weight_sum(sums, 3);
            }
            ShapeGradient<vf> out;
            project_backward<SLOPES>(r.view, s.shape, splat(r.view.near_m), f, out);
            for (int q = 0; q < 6; q++) twist[q] += only(first_lanes(count), out.twist[q]);
        }
        for (int q = 0; q < 6; q++) partial[tile.index * 6 + q] = lane_sum(twist[q]);
    };
    with_depth(r.options, [&](auto slopes) {
        constexpr bool SLOPES = decltype(slopes)::value != 0;
        const auto each = [&](Scratch& scratch, const Tile& tile) { finish(slopes, scratch, tile); };
        r.k <= 4 ? blend_tiles_backward<4, 4, false, SLOPES>(r, g, each) : blend_tiles_backward<7, 4, false, SLOPES>(r, g, each);
    });
    for (int q = 0; q < 6; q++) {
        g_twist[q] = 0;
        for (int t = 0; t < tiles; t++) g_twist[q] += partial[t * 6 + q];
    }
    if (seconds) seconds[0] += omp_get_wtime() - t0;
}

static void view_visible(const Context* context, uint8_t* visible) {
    const Render& r = *reinterpret_cast<const Render*>(context);
    for (int64_t i = 0; i < r.n; i++) visible[i] = r.tiles_of[i] > 0;
}
