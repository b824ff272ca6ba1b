// One Gauss–Newton step of direct alignment: a reference image with depth, warped into the live image by T_live_reference.
// Residuals: gray difference and depth difference, Huber weighted; left twist increment (ρ, φ) on T.
// H [21] upper triangle, b [6], sums: weighted cost, pixels used, pixels in view with depth, pixels agreeing in depth;
// S [21], upper triangle of Σ b_c b_cᵀ over cells c of 16×16 pixels: neighbours err together, cells hardly do.
constexpr int CELL = 16, NORMAL_TERMS = 21 + 6 + 4 + 21;
static_assert(CELL % W == 0, "a cell is whole vectors wide");

struct Bilinear { vf value, dx, dy; };
SIGMA_INLINE Bilinear interpolate(vf v00, vf v10, vf v01, vf v11, vf a, vf b) {
    const vf top = fma(a, v10 - v00, v00), bottom = fma(a, v11 - v01, v01);
    return {fma(b, bottom - top, top), fma(b, (v11 - v01) - (v10 - v00), v10 - v00), bottom - top};
}
SIGMA_INLINE vf huber_weight(vf r, vf width) { return min(splat(1.f), width / max(abs(r), splat(1e-12f))); }

// Residuals and derivatives of W reference pixels from (x, y): add to H and sums (acc) and to b (pull).
SIGMA_INLINE void add_pixels(const AlignLevel& L, const AlignOptions& o, const float* R, const float* t, int x, int y, vf* acc, vf* pull) {
    const size_t at = size_t(y) * L.width + x;
    const int lanes = L.width - x < W ? L.width - x : W;
    const Mask inside = first_lanes(lanes);
    alignas(64) float edge[4][W] = {};
    const float* planes[4] = {L.reference_depth, L.reference_gray, L.weight_gray, L.weight_depth};
    for (int k = 0; k < 4; k++) {
        if (!planes[k]) continue;
        planes[k] += at;
        if (lanes < W) { memcpy(edge[k], planes[k], lanes * 4); planes[k] = edge[k]; }
    }
    const auto [dp, gp, wi_p, wd_p] = planes;
    const vf d = load(dp);
    Mask ok = both(inside, gt(d, splat(0.f)));
    if (!any(ok)) return;
    const vf X = (lane_index() + (float(x) - L.cx)) * (1.f / L.fx) * d, Y = splat((float(y) - L.cy) / L.fy) * d;
    const vf px = R[0] * X + (R[1] * Y + (R[2] * d + t[0])), py = R[3] * X + (R[4] * Y + (R[5] * d + t[1])),
             pz = R[6] * X + (R[7] * Y + (R[8] * d + t[2]));
    ok = both(ok, gt(pz, splat(0.05f)));
    const vf iz = 1.f / max(pz, splat(0.05f)), xn = px * iz, yn = py * iz;
    vf u = L.fx * xn + L.cx, v = L.fy * yn + L.cy;
    ok = both(ok, both(both(ge(u, splat(0.f)), ge(v, splat(0.f))), both(gt(splat(L.width - 1.f), u), gt(splat(L.height - 1.f), v))));
    if (!any(ok)) return;
    u = clamp(u, 0.f, L.width - 1.001f);
    v = clamp(v, 0.f, L.height - 1.001f);
    const vf fu = floor(u), fv = floor(v), a = u - fu, c = v - fv;
    const vi i00 = to_int(fma(fv, splat(float(L.width)), fu));
    const Bilinear I = interpolate(gather(L.live_gray, i00), gather(L.live_gray + 1, i00), gather(L.live_gray + L.width, i00), gather(L.live_gray + L.width + 1, i00), a, c);
    const vf d00 = gather(L.live_depth, i00), d10 = gather(L.live_depth + 1, i00), d01 = gather(L.live_depth + L.width, i00), d11 = gather(L.live_depth + L.width + 1, i00);
    const Bilinear D = interpolate(d00, d10, d01, d11, a, c);
    const vf nearest = min(min(d00, d10), min(d01, d11)), farthest = max(max(d00, d10), max(d01, d11));
    const Mask read = both(ok, gt(nearest, splat(0.f)));       // all four neighbours have a reading
    const vf r_depth = D.value - pz, r_gray = I.value - load(gp);
    const Mask agrees = both(read, gt(splat(o.depth_gate), abs(r_depth)));
    // A depth step inside the 2×2 cell has no derivative; where the live depth is missing colour alone decides.
    const Mask smooth = both(agrees, gt(0.03f * pz, farthest - nearest));
    const Mask color_ok = both(ok, mask_or(agrees, mask_not(read)));
    const vf weight_gray = wi_p ? load(wi_p) : splat(1.f), weight_depth = wd_p ? load(wd_p) : splat(1.f);
    const vf hd = splat(o.huber_depth_relative) * pz * pz;    // sensor noise grows with z²
    const vf wi = only(color_ok, weight_gray * (o.weight_color / (o.huber_gray * o.huber_gray)) * huber_weight(r_gray, splat(o.huber_gray)));
    const vf wd = only(smooth, weight_depth * (o.weight_depth / (hd * hd)) * huber_weight(r_depth, hd));
    const vf fxz = L.fx * iz, fyz = L.fy * iz, zero = splat(0.f);
    const vf du[6] = {fxz, zero, -fxz * xn, -fxz * xn * py, fma(fxz * xn, px, fxz * pz), -fxz * py};
    const vf dv[6] = {zero, fyz, -fyz * yn, -fma(fyz * yn, py, fyz * pz), fyz * yn * px, fyz * px};
    vf Ji[6], Jd[6];
    for (int k = 0; k < 6; k++) { Ji[k] = fma(I.dx, du[k], I.dy * dv[k]); Jd[k] = fma(D.dx, du[k], D.dy * dv[k]); }
    Jd[2] -= 1.f; Jd[3] -= py; Jd[4] += px;
    int q = 0;
    for (int i = 0; i < 6; i++) {
        const vf ji = wi * Ji[i], jd = wd * Jd[i];
        for (int j = i; j < 6; j++, q++) acc[q] = fma(ji, Ji[j], fma(jd, Jd[j], acc[q]));
        pull[i] = fma(ji, r_gray, fma(jd, r_depth, pull[i]));
    }
    acc[21] += fma(wi * r_gray, r_gray, wd * r_depth * r_depth);
    acc[22] += only(color_ok, splat(1.f));
    acc[23] += only(read, splat(1.f));
    acc[24] += only(agrees, splat(1.f));
}

static void align_step(const AlignLevel* level, const AlignOptions* o, const double* T, double* H, double* b, double* S, double* sums) {
    const AlignLevel& L = *level;
    float R[9], t[3];
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) R[3 * i + j] = float(T[4 * i + j]);
        t[i] = float(T[4 * i + 3]);
    }
    const int bands = (L.height + CELL - 1) / CELL, cells = (L.width + CELL - 1) / CELL;
    Buffer<double> band_sums;
    band_sums.reserve(size_t(bands) * NORMAL_TERMS);
#pragma omp parallel for schedule(dynamic, 1)
    for (int band = 0; band < bands; band++) {
        vf acc[21 + 4];                               // H and sums; b is taken cell by cell
        for (auto& a : acc) a = splat(0.f);
        double* total = &band_sums[size_t(band) * NORMAL_TERMS];
        for (int cell = 0; cell < cells; cell++) {
            vf pull[6];
            for (auto& a : pull) a = splat(0.f);
            const int bottom = (band + 1) * CELL < L.height ? (band + 1) * CELL : L.height, right = (cell + 1) * CELL < L.width ? (cell + 1) * CELL : L.width;
            for (int y = band * CELL; y < bottom; y++)
                for (int x = cell * CELL; x < right; x += W) add_pixels(L, *o, R, t, x, y, acc, pull);
            double g[6];
            for (int k = 0; k < 6; k++) { g[k] = lane_sum(pull[k]); total[21 + k] += g[k]; }
            for (int i = 0, q = 31; i < 6; i++)
                for (int j = i; j < 6; j++, q++) total[q] += g[i] * g[j];
        }
        for (int k = 0; k < 21; k++) total[k] = lane_sum(acc[k]);
        for (int k = 0; k < 4; k++) total[27 + k] = lane_sum(acc[21 + k]);
    }
    double total[NORMAL_TERMS] = {};
    for (int band = 0; band < bands; band++)
        for (int k = 0; k < NORMAL_TERMS; k++) total[k] += band_sums[size_t(band) * NORMAL_TERMS + k];
    memcpy(H, total, 21 * sizeof(double));
    memcpy(b, total + 21, 6 * sizeof(double));
    memcpy(sums, total + 27, 4 * sizeof(double));
    memcpy(S, total + 31, 21 * sizeof(double));
}

// ---- the loop: steps of a tenth of a millisecond do not wait for Python ------------------------------------------------

// Eigenvalues and, as columns of V, eigenvectors of a symmetric 6×6 matrix, by cyclic Jacobi rotations.
static void eigen6(double (*A)[6], double* values, double (*V)[6]) {
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) V[i][j] = i == j;
    for (int sweep = 0; sweep < 30; sweep++) {
        double off = 0, all = 0;
        for (int i = 0; i < 6; i++)
            for (int j = 0; j < 6; j++) { all += A[i][j] * A[i][j]; if (i != j) off += A[i][j] * A[i][j]; }
        if (off <= 1e-30 * all) break;
        for (int p = 0; p < 5; p++)
            for (int q = p + 1; q < 6; q++) {
                if (A[p][q] == 0) continue;
                const double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                const double t = (theta < 0 ? -1 : 1) / (__builtin_fabs(theta) + __builtin_sqrt(theta * theta + 1));
                const double c = 1 / __builtin_sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < 6; k++) { const double a = A[k][p], b = A[k][q]; A[k][p] = c * a - s * b; A[k][q] = s * a + c * b; }
                for (int k = 0; k < 6; k++) { const double a = A[p][k], b = A[q][k]; A[p][k] = c * a - s * b; A[q][k] = s * a + c * b; }
                for (int k = 0; k < 6; k++) { const double a = V[k][p], b = V[k][q]; V[k][p] = c * a - s * b; V[k][q] = s * a + c * b; }
            }
    }
    for (int i = 0; i < 6; i++) values[i] = A[i][i];
}

// Gauss–Newton update −H⁻¹ b within the directions whose information is more than `share` of the best one's, rotations
// measured by the shift they make at depth_m; returns how many directions are left out (fit/align.py `_axes`).
static int solve_decided(const double* H, const double* b, double depth_m, double share, double* update) {
    double A[6][6], V[6][6], values[6], best = 1e-300;
    for (int i = 0, q = 0; i < 6; i++)
        for (int j = i; j < 6; j++, q++) A[i][j] = A[j][i] = H[q] / ((i < 3 ? 1.0 : depth_m) * (j < 3 ? 1.0 : depth_m));
    eigen6(A, values, V);
    for (double v : values) best = v > best ? v : best;
    int left_out = 0;
    for (int i = 0; i < 6; i++) update[i] = 0;
    for (int k = 0; k < 6; k++) {
        if (!(values[k] > share * best)) { left_out++; continue; }
        double along = 0;
        for (int i = 0; i < 6; i++) along += V[i][k] * b[i] / (i < 3 ? 1.0 : depth_m);
        for (int i = 0; i < 6; i++) update[i] -= V[i][k] / (i < 3 ? 1.0 : depth_m) * along / values[k];
    }
    return left_out;
}

// T ← exp(twist) · T, T a 4×4 of a rigid motion.
static void move_left(const double* twist, double* T) {
    const double *r = twist, *w = twist + 3, theta2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], theta = __builtin_sqrt(theta2);
    const bool small = theta2 < 1e-12;
    const double a = small ? 1 - theta2 / 6 : __builtin_sin(theta) / theta, b = small ? 0.5 - theta2 / 24 : (1 - __builtin_cos(theta)) / theta2,
                 c = small ? 1.0 / 6 - theta2 / 120 : (1 - a) / theta2;
    const double K[3][3] = {{0, -w[2], w[1]}, {w[2], 0, -w[0]}, {-w[1], w[0], 0}};
    double E[3][4], moved[3][4];
    for (int i = 0; i < 3; i++) {
        E[i][3] = 0;
        for (int j = 0; j < 3; j++) {
            const double K2 = w[i] * w[j] - (i == j ? theta2 : 0);
            E[i][j] = (i == j) + a * K[i][j] + b * K2;
            E[i][3] += ((i == j) + b * K[i][j] + c * K2) * r[j];
        }
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 4; j++) moved[i][j] = E[i][0] * T[j] + E[i][1] * T[4 + j] + E[i][2] * T[8 + j] + (j == 3 ? E[i][3] : 0);
    memcpy(T, moved, sizeof moved);
}

// Align from the coarsest level, `levels[count - 1]`, to the finest; fit/align.py `align` says how. T goes in as the guess and
// comes out as the motion; found: sums of the last or best iterate of the finest level. Returns the steps taken.
static int align_images(const AlignLevel* levels, const AlignOptions* options, int count, AlignLoop o, double* T, double* found, int* degenerate) {
    double H[21], b[6], S[21], sums[4] = {}, update[6], best_T[12], best_sums[4];
    int steps = 0;
    for (int level = count - 1; level >= 0; level--) {
        double best = __builtin_inf(), previous = __builtin_inf();
        bool settled = false;
        *degenerate = 6;
        for (int i = 0; i < o.iterations && !settled; i++) {
            align_step(&levels[level], &options[level], T, H, b, S, sums);
            steps++;
            if (sums[1] < o.min_pixels) break;
            const double cost = sums[0] / sums[1];
            if (cost < best) { best = cost; memcpy(best_T, T, sizeof best_T); memcpy(best_sums, sums, sizeof best_sums); }
            *degenerate = solve_decided(H, b, o.depth_m, o.degenerate_share, update);
            move_left(update, T);
            settled = true;
            for (double u : update) settled = settled && __builtin_fabs(u) < o.update_stop;
            settled = settled || __builtin_fabs(cost - previous) < o.plateau_stop * cost;
            previous = cost;
        }
        const bool keep_best = !settled && best < __builtin_inf();
        if (keep_best) memcpy(T, best_T, sizeof best_T);
        memcpy(found, keep_best ? best_sums : sums, 4 * sizeof(double));
    }
    return steps;
}
