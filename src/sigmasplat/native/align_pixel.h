// Residuals and derivatives of one reference pixel, or of one pixel per vector lane. A reference image with depth is
// warped into the live image by T_live_reference. Residuals: gray difference and depth difference, with Huber weights;
// the increment is a left twist (ρ, φ) on T. Written with vf, vi, Mask and the functions of lanes.h; on a GPU a thread
// is a vector of one lane (see align.cu). Has no includes and no namespace.

constexpr int CELL = 16;                   // size in pixels: errors are correlated within a cell, hardly between cells
// Fewer rows are enough where sums are only compared with others of the same rows: every so many, at least 120 of them.
SIGMA_INLINE int rows_apart(int height) { return height < 240 ? 1 : height / 120; }
constexpr int MATRIX_TERMS = 21, COUNTS = 4; // upper triangle of a 6×6; cost, pixels used, in view with depth, agreeing
constexpr int SUMS = COUNTS + 2;           // and gray of live and of reference pixels, by their weights
constexpr int COMMON = MATRIX_TERMS + 6 + COUNTS;                      // a fifth count, over cells: `common_pixels`
constexpr int GRAYS = COMMON + 1 + MATRIX_TERMS;                       // H, b, counts, S = Σ b_c b_cᵀ over cells c; then the grays
constexpr int NORMAL_TERMS = GRAYS + 2;

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

// The motion from a reference row that was read `late_s` after its image's time, to second order: T exp(late_s · rate).
SIGMA_INLINE Motion motion_of_row(const Motion& T, const float* rate, float late_s) {
    const float *v = rate, *w = rate + 3;
    Motion m = T;
    for (int i = 0; i < 3; i++) {
        float a = T.R[3 * i], b = T.R[3 * i + 1], c = T.R[3 * i + 2];
        for (float share : {late_s, 0.5f * late_s * late_s}) {
            m.t[i] += share * (a * v[0] + b * v[1] + c * v[2]);
            const float x = b * w[2] - c * w[1], y = c * w[0] - a * w[2], z = a * w[1] - b * w[0];
            m.R[3 * i] += share * (a = x);
            m.R[3 * i + 1] += share * (b = y);
            m.R[3 * i + 2] += share * (c = z);
        }
    }
    return m;
}
SIGMA_INLINE Motion motion_of_depth_row(const AlignPinhole& L, const Motion& T, const Readout& r, int y) {
    return motion_of_row(T, r.rate, r.late_s + r.depth_rows_s * ((y + 0.5f) / L.height - 0.5f));
}
SIGMA_INLINE Motion motion_of_gray_row(const AlignPinhole& L, const Motion& T, const Readout& r, int y) {
    return motion_of_row(T, r.rate, r.gray_rows_s * ((y + 0.5f) / L.height - 0.5f));
}
// Live rows that are read one after another while the camera moves: moves a position in the live camera from the time of the
// image to the time of the row that shows it.
struct RowByRow {
    const float* rate;
    float first_s, rows_s, fy, cy;         // when the first row is read; from it to the last, over the height
    void operator()(vf& x, vf& y, vf& z) const {
        const Point3<vf> at_once = {x, y, z};
        vf iz = 1.f / max(z, splat(0.05f));
        for (int round = 0; round < 2; round++) {                  // the row is another one when it is read
            const vf row = fma(fy * y, iz, splat(cy)), late_s = fma(row, splat(rows_s), splat(first_s));
            const Point3<vf> read = moved(at_once, rate, -late_s);
            iz = clamp(iz * (2.f - read.z * iz), 0.f, 20.f);       // a Newton step: z hardly changes
            x = read.x;
            y = read.y;
            z = read.z;
        }
    }
};
SIGMA_INLINE RowByRow depth_rows(const AlignPinhole& L, const Readout& r) {
    return {r.rate, r.late_s - 0.5f * r.depth_rows_s, r.depth_rows_s / L.height, L.fy, L.cy + 0.5f};
}
SIGMA_INLINE RowByRow gray_rows(const AlignPinhole& L, const Readout& r) {
    return {r.rate, -0.5f * r.gray_rows_s, r.gray_rows_s / L.height, L.fy, L.cy + 0.5f};
}

// The number of a cell's pixels that both cameras see: those in view, unless live depth has a large hole there. Holes
// that are scattered do not matter as long as a quarter of the pixels fall on a reading.
inline double common_pixels(double in_view, double read) { return in_view < 4.0 * read ? in_view : 4.0 * read; }

// Gray and depth of live pixels: at a position, to its right, below it, and to the right of that.
struct Neighbours { vf gray[4], depth[4]; };

// Reference pixels in the live camera: position (px, py, pz), 1 / pz, and the live pixel `at` up and left of them, with the
// shares (a, c) of the one to its right and the one below. ok: lanes that are used.
struct Warped { vf px, py, pz, iz, a, c; vi at; Mask ok; };
// A live image whose rows were all read at its time.
struct AtOnce { void operator()(vf&, vf&, vf&) const {} };
// off_x, off_y: position relative to the principal point. inside: lanes that are pixels of the image. read: moves positions
// from the live camera at the time of its image to that at the time of their row. Returns whether any lane is used.
template <class Read>
SIGMA_INLINE bool warp(const AlignPinhole& L, const Motion& T, vf d, vf off_x, float off_y, Mask inside, const Read& read, Warped& w) {
    const float *R = T.R, *t = T.t;
    w.ok = both(inside, gt(d, splat(0.f)));
    if (!any(w.ok)) return false;
    const vf X = off_x * (1.f / L.fx) * d, Y = splat(off_y / L.fy) * d;
    w.px = R[0] * X + (R[1] * Y + (R[2] * d + t[0]));
    w.py = R[3] * X + (R[4] * Y + (R[5] * d + t[1]));
    w.pz = R[6] * X + (R[7] * Y + (R[8] * d + t[2]));
    read(w.px, w.py, w.pz);
    w.ok = both(w.ok, gt(w.pz, splat(0.05f)));
    w.iz = 1.f / max(w.pz, splat(0.05f));
    vf u = L.fx * (w.px * w.iz) + L.cx, v = L.fy * (w.py * w.iz) + L.cy;
    w.ok = both(w.ok, both(both(ge(u, splat(0.f)), ge(v, splat(0.f))), both(gt(splat(L.width - 1.f), u), gt(splat(L.height - 1.f), v))));
    if (!any(w.ok)) return false;
    u = clamp(u, 0.f, L.width - 1.001f);
    v = clamp(v, 0.f, L.height - 1.001f);
    const vf fu = floor(u), fv = floor(v);
    w.a = u - fu;
    w.c = v - fv;
    w.at = to_int(fma(fv, splat(float(L.width)), fu));
    return true;
}

struct ReferencePixels { vf gray, weight_gray, weight_depth, noise; };   // 1 without weights, or without noise
// Residuals of gray and depth, their weights, and the derivatives of the live images.
struct Residuals { vf gray, depth, weight_gray, weight_depth, gray_dx, gray_dy, depth_dx, depth_dy; };

// Compare warped pixels with the live images, of which `near` are the neighbours; gray can be warped by itself (`wg`, with
// neighbours g), and is in view where depth is. Adds to sums [4].
SIGMA_INLINE Residuals compared(const AlignOptions& o, const Warped& w, const Neighbours& near, const Warped& wg, const vf* g, const ReferencePixels& pixels, vf* sums) {
    const vf d00 = near.depth[0], d10 = near.depth[1], d01 = near.depth[2], d11 = near.depth[3];
    const Mask ok = w.ok;
    const Bilinear I = interpolate(g[0], g[1], g[2], g[3], wg.a, wg.c);
    Bilinear D = interpolate(d00, d10, d01, d11, w.a, w.c);
    vf nearest = min(min(d00, d10), min(d01, d11));
    const vf farthest = max(max(d00, d10), max(d01, d11));
    Mask read = both(ok, gt(nearest, splat(0.f))), planar = read;
    if (any(both(ok, mask_not(read)))) {                       // a hole among the neighbours of some pixel
        const Sparse s = interpolate_readings(d00, d10, d01, d11, w.a, w.c);
        D = {select(read, D.value, s.at.value), select(read, D.dx, s.at.dx), select(read, D.dy, s.at.dy)};
        nearest = s.nearest;
        planar = both(ok, s.planar);
        read = both(ok, s.read);
    }
    const vf r_depth = D.value - w.pz, r_gray = fma(splat(o.gain), I.value, -pixels.gray);
    const Mask agrees = both(read, gt(splat(o.depth_gate), abs(r_depth)));
    // No derivative is used where the neighbours do not determine it or contain a depth step. Without live depth only
    // colour is used.
    const Mask smooth = both(both(agrees, planar), gt(0.03f * w.pz, farthest - nearest));
    const Mask color_ok = both(ok, mask_or(agrees, mask_not(read)));
    // Sensor noise grows with z², unless readings have their own.
    const vf hd = splat(o.huber_depth_relative) * w.pz * w.pz * max(pixels.noise, splat(1e-3f));
    const vf wi = only(color_ok, pixels.weight_gray * (o.weight_color / (o.huber_gray * o.huber_gray)) * huber_weight(r_gray, splat(o.huber_gray)));
    const vf wd = only(smooth, pixels.weight_depth * (o.weight_depth / (hd * hd)) * huber_weight(r_depth, hd));
    sums[0] += fma(wi * r_gray, r_gray, wd * r_depth * r_depth);
    sums[1] += only(color_ok, splat(1.f));
    sums[2] += only(read, splat(1.f));
    sums[3] += only(agrees, splat(1.f));
    sums[4] += wi * I.value;
    sums[5] += wi * pixels.gray;
    return {r_gray, r_depth, wi, wd, splat(o.gain) * I.dx, splat(o.gain) * I.dy, D.dx, D.dy};
}

// Derivatives of both residuals with respect to the left twist.
struct Derivatives { vf gray[6], depth[6]; };
SIGMA_INLINE Derivatives derivatives(const AlignPinhole& L, const Warped& w, const Residuals& r) {
    const vf xn = w.px * w.iz, yn = w.py * w.iz, fxz = L.fx * w.iz, fyz = L.fy * w.iz, zero = splat(0.f);
    const vf du[6] = {fxz, zero, -fxz * xn, -fxz * xn * w.py, fma(fxz * xn, w.px, fxz * w.pz), -fxz * w.py};
    const vf dv[6] = {zero, fyz, -fyz * yn, -fma(fyz * yn, w.py, fyz * w.pz), fyz * yn * w.px, fyz * w.px};
    Derivatives J;
    for (int k = 0; k < 6; k++) { J.gray[k] = fma(r.gray_dx, du[k], r.gray_dy * dv[k]); J.depth[k] = fma(r.depth_dx, du[k], r.depth_dy * dv[k]); }
    J.depth[2] -= 1.f; J.depth[3] -= w.py; J.depth[4] += w.px;
    return J;
}

// Add `count` vectors of pixels to the rows FROM to TO - 1 of H's upper triangle and of b. Few rows at once, so that their
// sums stay in registers.
constexpr int row_begin(int i) { return i * 6 - i * (i - 1) / 2; }
template <int FROM, int TO>
SIGMA_INLINE void add_rows(const Residuals* r, const Derivatives* J, int count, vf* H, vf* b) {
    constexpr int BEGIN = row_begin(FROM), TERMS = row_begin(TO) - BEGIN;
    vf h[TERMS], g[TO - FROM];
    for (int q = 0; q < TERMS; q++) h[q] = H[BEGIN + q];
    for (int i = FROM; i < TO; i++) g[i - FROM] = b[i];
    for (int k = 0; k < count; k++) {
        int q = 0;
        for (int i = FROM; i < TO; i++) {
            const vf ji = r[k].weight_gray * J[k].gray[i], jd = r[k].weight_depth * J[k].depth[i];
            for (int j = i; j < 6; j++, q++) h[q] = fma(ji, J[k].gray[j], fma(jd, J[k].depth[j], h[q]));
            g[i - FROM] = fma(ji, r[k].gray, fma(jd, r[k].depth, g[i - FROM]));
        }
    }
    for (int q = 0; q < TERMS; q++) H[BEGIN + q] = h[q];
    for (int i = FROM; i < TO; i++) b[i] = g[i - FROM];
}
