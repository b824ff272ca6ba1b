// Stage 1: splats → footprints. Lanes are splats.

constexpr int ROW = 17;                    // columns of GaussianField.params
constexpr int CHUNK = 512;                 // splats per unit of work: fixed, so sums do not depend on the thread count

SIGMA_INLINE View<float> read_view(const float* numbers) { View<float> v; memcpy(&v, numbers, sizeof v); return v; }

// Load W rows as lanes, lanes[column][row]. Complete groups of W columns are transposed in registers, the others one by
// one.
template <int COLUMNS> SIGMA_INLINE void turn_rows(const float* const* rows, float (*lanes)[W]) {
    constexpr int TURNED = COLUMNS / W * W;
    for (int g = 0; g < TURNED; g += W) {
        vf turn[W];
        for (int l = 0; l < W; l++) turn[l] = load(rows[l] + g);
        transpose(turn);
        for (int k = 0; k < W; k++) store(lanes[g + k], turn[k]);
    }
    for (int k = TURNED; k < COLUMNS; k++)
        for (int l = 0; l < W; l++) lanes[k][l] = rows[l][k];
}
// Load W rows of a row-major [n, columns] array as lanes; rows past the end repeat the last one.
template <int COLUMNS> SIGMA_INLINE void load_rows(const float* rows, int64_t first, int64_t n, float (*lanes)[W]) {
    const float* row[W];
    if (first + W <= n)
        for (int l = 0; l < W; l++) row[l] = rows + (first + l) * COLUMNS;
    else
        for (int l = 0; l < W; l++) row[l] = rows + (first + l < n ? first + l : n - 1) * COLUMNS;
    turn_rows<COLUMNS>(row, lanes);
}
template <int COLUMNS> SIGMA_INLINE void store_rows(float* rows, int64_t first, int64_t n, const float (*lanes)[W]) {
    const int count = n - first < W ? int(n - first) : W;
    constexpr int TURNED = COLUMNS / W * W;
    for (int g = 0; g < TURNED; g += W) {
        vf turn[W];
        for (int k = 0; k < W; k++) turn[k] = load(lanes[g + k]);
        transpose(turn);
        for (int l = 0; l < count; l++) store(rows + (first + l) * COLUMNS + g, turn[l]);
    }
    for (int k = TURNED; k < COLUMNS; k++)
        for (int l = 0; l < count; l++) rows[(first + l) * COLUMNS + k] = lanes[k][l];
}

SIGMA_INLINE Shape<vf> load_shape(const float* means, const float* quats, const float* scales, int64_t i, int64_t n) {
    alignas(64) float t[4][W];
    Shape<vf> s;
    load_rows<3>(means, i, n, t);
    for (int k = 0; k < 3; k++) s.mean[k] = load(t[k]);
    load_rows<4>(quats, i, n, t);
    for (int k = 0; k < 4; k++) s.quat[k] = load(t[k]);
    load_rows<3>(scales, i, n, t);
    for (int k = 0; k < 3; k++) s.scale[k] = load(t[k]);
    return s;
}

// Not inlined: beside `project` the compiler would contract its sums in another order, and change bytes.
__attribute__((noinline)) static void add_slopes_to(const View<float>& view, const Shape<vf>& s, Footprint<vf>& f) {
    add_slopes(view, s, splat(view.near_m), f);
}

// slopes [n, 2], or null: the slopes of depth, m/px, 0 for splats that are not seen.
static void project_forward(const float* view_numbers, const float* means, const float* quats, const float* scales,
                            int64_t n, float* means2d, float* conics, float* z, float* radii, float* slopes) {
    const View<float> view = read_view(view_numbers);
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n; i += W) {
        const Shape<vf> shape = load_shape(means, quats, scales, i, n);
        Footprint<vf> f = project(view, shape, splat(view.near_m));
        const Mask seen = gt(f.z, splat(view.near_m));
        alignas(64) float t[3][W];
        if (slopes) {
            add_slopes_to(view, shape, f);
            store(t[0], only(seen, f.slope_u)); store(t[1], only(seen, f.slope_v));
            store_rows<2>(slopes, i, n, t);
        }
        store(t[0], f.u); store(t[1], f.v);
        store_rows<2>(means2d, i, n, t);
        store(t[0], f.l1); store(t[1], f.l2); store(t[2], f.l3);
        store_rows<3>(conics, i, n, t);
        store(t[0], f.z);
        store_rows<1>(z, i, n, t);
        store(t[0], only(seen, sqrt(f.var_u))); store(t[1], only(seen, sqrt(f.var_v)));
        store_rows<2>(radii, i, n, t);
    }
}

static void project_backward(const float* view_numbers, const float* means, const float* quats, const float* scales,
                             int64_t n, const float* radii, const float* g_means2d, const float* g_conics,
                             const float* g_z, float* g_means, float* g_quats, float* g_scales, double* g_twist) {
    const View<float> view = read_view(view_numbers);
    const int64_t chunks = (n + CHUNK - 1) / CHUNK;
    Buffer<double> partial;
    partial.reserve(chunks * 6 + 1);
#pragma omp parallel for schedule(static)
    for (int64_t c = 0; c < chunks; c++) {
        vf twist[6];
        for (auto& x : twist) x = splat(0.f);
        for (int64_t i = c * CHUNK; i < n && i < (c + 1) * CHUNK; i += W) {
            alignas(64) float t[4][W];
            FootprintGradient<vf> g;
            load_rows<2>(radii, i, n, t);
            const Mask seen = both(gt(load(t[0]), splat(0.f)), first_lanes(n - i < W ? int(n - i) : W));
            load_rows<2>(g_means2d, i, n, t);
            g.u = load(t[0]); g.v = load(t[1]);
            load_rows<3>(g_conics, i, n, t);
            g.l1 = load(t[0]); g.l2 = load(t[1]); g.l3 = load(t[2]);
            load_rows<1>(g_z, i, n, t);
            g.z = load(t[0]);
            ShapeGradient<vf> out;
            project_backward(view, load_shape(means, quats, scales, i, n), splat(view.near_m), g, out);
            for (int k = 0; k < 6; k++) twist[k] += only(seen, out.twist[k]);
            for (int k = 0; k < 3; k++) store(t[k], only(seen, out.mean[k]));
            store_rows<3>(g_means, i, n, t);
            for (int k = 0; k < 4; k++) store(t[k], only(seen, out.quat[k]));
            store_rows<4>(g_quats, i, n, t);
            for (int k = 0; k < 3; k++) store(t[k], only(seen, out.scale[k]));
            store_rows<3>(g_scales, i, n, t);
        }
        for (int k = 0; k < 6; k++) partial[c * 6 + k] = lane_sum(twist[k]);
    }
    for (int k = 0; k < 6; k++) {
        g_twist[k] = 0;
        for (int64_t c = 0; c < chunks; c++) g_twist[k] += partial[c * 6 + k];
    }
}
