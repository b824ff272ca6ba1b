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
    const float *dp = L.reference_depth + at, *gp = L.reference_gray + at, *wp = L.weight ? L.weight + at : nullptr;
    if (lanes < W) {
        memcpy(edge[0], dp, lanes * 4); memcpy(edge[1], gp, lanes * 4);
        if (wp) memcpy(edge[2], wp, lanes * 4);
        dp = edge[0]; gp = edge[1]; wp = wp ? edge[2] : nullptr;
    }
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
    const vf weight = wp ? load(wp) : splat(1.f);
    const vf hd = splat(o.huber_depth_relative) * pz * pz;    // sensor noise grows with z²
    const vf wi = only(color_ok, weight * (o.weight_color / (o.huber_gray * o.huber_gray)) * huber_weight(r_gray, splat(o.huber_gray)));
    const vf wd = only(smooth, weight * (o.weight_depth / (hd * hd)) * huber_weight(r_depth, hd));
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
