// Residuals and derivatives of one reference pixel, or of one pixel per vector lane. A reference image with depth is
// warped into the live image by T_live_reference. Residuals: gray difference and depth difference, with Huber weights;
// the increment is a left twist (ρ, φ) on T. Written with vf, vi, Mask and the functions of lanes.h; on a GPU a thread
// is a vector of one lane (see align.cu). Has no includes and no namespace.

constexpr int CELL = 16;                   // size in pixels: errors are correlated within a cell, hardly between cells
constexpr int MATRIX_TERMS = 21, SUMS = 4; // upper triangle of a 6×6; cost, pixels used, in view with depth, agreeing
constexpr int COMMON = MATRIX_TERMS + 6 + SUMS;                        // a fifth sum, over cells: `common_pixels`
constexpr int NORMAL_TERMS = COMMON + 1 + MATRIX_TERMS;                // H, b, sums, and S = Σ b_c b_cᵀ over cells c

struct Bilinear { vf value, dx, dy; };
SIGMA_INLINE Bilinear interpolate(vf v00, vf v10, vf v01, vf v11, vf a, vf b) {
    const vf top = fma(a, v10 - v00, v00), bottom = fma(a, v11 - v01, v01);
    return {fma(b, bottom - top, top), fma(b, (v11 - v01) - (v10 - v00), v10 - v00), bottom - top};
}
// Depth between four neighbours of which some have no reading (0). A plane through the readings: exact for three. A
// derivative is 0 if no pair of readings determines it. planar: both derivatives are determined.
struct Sparse { Bilinear at; Mask read, planar; vf nearest; };
SIGMA_INLINE Sparse interpolate_readings(vf v00, vf v10, vf v01, vf v11, vf a, vf b) {
    const vf none = splat(0.f), one = splat(1.f), far = splat(1e9f);
    const Mask m00 = gt(v00, none), m10 = gt(v10, none), m01 = gt(v01, none), m11 = gt(v11, none);
    const Mask top = both(m00, m10), bottom = both(m01, m11), left = both(m00, m01), right = both(m10, m11);
    // With a hole among the four, at most one of the two pairs along an axis is complete.
    const vf dx = only(top, v10 - v00) + only(bottom, v11 - v01), dy = only(left, v01 - v00) + only(right, v11 - v10);
    const vf n10 = only(m10, one), n01 = only(m01, one), n11 = only(m11, one), n = only(m00, one) + n10 + n01 + n11;
    const vf sum = v00 + v10 + v01 + v11 - dx * (n10 + n11) - dy * (n01 + n11);
    const vf nearest = min(min(select(m00, v00, far), select(m10, v10, far)), min(select(m01, v01, far), select(m11, v11, far)));
    return {{sum / max(n, one) + dx * a + dy * b, dx, dy}, gt(n, none), both(mask_or(top, bottom), mask_or(left, right)), nearest};
}
SIGMA_INLINE vf huber_weight(vf r, vf width) { return min(splat(1.f), width / max(abs(r), splat(1e-12f))); }

// The rotation and translation of T (rows of a 4×4), in the precision of the pixels.
struct Motion { float R[9], t[3]; };
SIGMA_INLINE Motion motion_of(const double* T) {
    Motion m;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) m.R[3 * i + j] = float(T[4 * i + j]);
        m.t[i] = float(T[4 * i + 3]);
    }
    return m;
}

struct ReferencePixels { const float *depth, *gray, *weight_gray, *weight_depth, *noise; };   // weights and noise may be null

// The number of a cell's pixels that both cameras see: those in view, unless live depth has a large hole there. Holes
// that are scattered do not matter as long as a quarter of the pixels fall on a reading.
inline double common_pixels(double in_view, double read) { return in_view < 4.0 * read ? in_view : 4.0 * read; }

// Gray and depth of live pixels: at a position, to its right, below it, and to the right of that.
struct Neighbours { vf gray[4], depth[4]; };

// Add residuals and derivatives of reference pixels to H (acc, 21), sums (acc + 21, 4) and b (pull, 6). off_x, off_y:
// position relative to the principal point. inside: lanes that are pixels of the image. `neighbours(live, i)` reads the live
// pixels next to those with the numbers i.
template <class Live>
SIGMA_INLINE void add_residuals(const AlignLevel& L, const Live& live, const AlignOptions& o, const Motion& T, vf off_x, float off_y, Mask inside,
                                const ReferencePixels& pixels, vf* acc, vf* pull) {
    const float *R = T.R, *t = T.t;
    const vf d = load(pixels.depth);
    Mask ok = both(inside, gt(d, splat(0.f)));
    if (!any(ok)) return;
    const vf X = off_x * (1.f / L.fx) * d, Y = splat(off_y / L.fy) * d;
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
    const Neighbours near = neighbours(live, i00);
    const vf *g = near.gray, d00 = near.depth[0], d10 = near.depth[1], d01 = near.depth[2], d11 = near.depth[3];
    const Bilinear I = interpolate(g[0], g[1], g[2], g[3], a, c);
    Bilinear D = interpolate(d00, d10, d01, d11, a, c);
    vf nearest = min(min(d00, d10), min(d01, d11));
    const vf farthest = max(max(d00, d10), max(d01, d11));
    Mask read = both(ok, gt(nearest, splat(0.f))), planar = read;
    if (any(both(ok, mask_not(read)))) {                       // a hole among the neighbours of some pixel
        const Sparse s = interpolate_readings(d00, d10, d01, d11, a, c);
        D = {select(read, D.value, s.at.value), select(read, D.dx, s.at.dx), select(read, D.dy, s.at.dy)};
        nearest = s.nearest;
        planar = both(ok, s.planar);
        read = both(ok, s.read);
    }
    const vf r_depth = D.value - pz, r_gray = I.value - load(pixels.gray);
    const Mask agrees = both(read, gt(splat(o.depth_gate), abs(r_depth)));
    // No derivative is used where the neighbours do not determine it or contain a depth step. Without live depth only
    // colour is used.
    const Mask smooth = both(both(agrees, planar), gt(0.03f * pz, farthest - nearest));
    const Mask color_ok = both(ok, mask_or(agrees, mask_not(read)));
    const vf weight_gray = pixels.weight_gray ? load(pixels.weight_gray) : splat(1.f), weight_depth = pixels.weight_depth ? load(pixels.weight_depth) : splat(1.f);
    vf hd = splat(o.huber_depth_relative) * pz * pz;          // sensor noise grows with z², unless readings have their own
    if (pixels.noise) hd = hd * max(load(pixels.noise), splat(1e-3f));
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
    acc[MATRIX_TERMS] += fma(wi * r_gray, r_gray, wd * r_depth * r_depth);
    acc[MATRIX_TERMS + 1] += only(color_ok, splat(1.f));
    acc[MATRIX_TERMS + 2] += only(read, splat(1.f));
    acc[MATRIX_TERMS + 3] += only(agrees, splat(1.f));
}
