// The maths of one splat: EWA projection and its derivative, templated on the number type (float, double, SIMD lanes).
// Has no includes and no namespace: include it where the functions sqrt, max, clamp, ge, both, select and only of T are
// declared. Notation: CG-SLAM §2.1. S is the scalar type of the camera's numbers.

template <class S> struct View {          // pinhole + pose: p_camera = R · p_world + t
    S fx, fy, cx, cy;
    S R[9], t[3];
    S near_m, low_pass;
    S lim_x_low, lim_x_high, lim_y_low, lim_y_high;   // limits of x/z in the Jacobian, as in 3DGS
    S width, height;
    S pose_mean, pose_covariance, pose_depth;         // 1 or 0: paths included in the pose gradient
};

template <class T> struct Shape {         // one splat, activated values
    T mean[3], quat[4], scale[3];
};

template <class T> struct Footprint {     // its image: mean, Cholesky conic, depth, variances along the image axes
    T u, v, z;
    T l1, l2, l3;
    T var_u, var_v;
    T slope_u, slope_v;                   // set by add_slopes: its depth at a pixel is z + slope_u·(x − u) + slope_v·(y − v), m/px
};

template <class T> struct FootprintGradient { T u, v, z, l1, l2, l3, slope_u, slope_v; };
template <class T> struct ShapeGradient { T mean[3], quat[4], scale[3], twist[6]; };

template <class T> struct Intermediate {  // shared by forward and backward
    T p[3], inv_z, xn, yn;                // camera-frame point, 1/z, x/z, y/z
    T xc, yc;                             // clamped x/z, y/z
    T q[4], inv_norm;                     // unit quaternion
    T Rq[9], V[9];                        // splat rotation; V = R_cw · Rq · diag(s)
    T fxz, fyz, jx, jy;                   // J = [fxz 0 −jx; 0 fyz −jy]
    T a[3], b[3];                         // rows of A = J·V
    T ca, cb, cc, det, n[3];              // Σ2D and its determinant, n = a×b
};

template <class T> inline __attribute__((always_inline)) void cross(const T* a, const T* b, T* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

template <class T> inline __attribute__((always_inline)) T dot3(const T* a, const T* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class T, class S>
inline __attribute__((always_inline)) void intermediate(const View<S>& view, const Shape<T>& s, T safe_z_floor, Intermediate<T>& m) {
    for (int i = 0; i < 3; i++)
        m.p[i] = view.R[3 * i] * s.mean[0] + (view.R[3 * i + 1] * s.mean[1] + (view.R[3 * i + 2] * s.mean[2] + view.t[i]));
    T z = max(m.p[2], safe_z_floor);      // culled splats still need finite arithmetic
    m.inv_z = S(1) / z;
    m.xn = m.p[0] * m.inv_z;
    m.yn = m.p[1] * m.inv_z;
    m.xc = clamp(m.xn, view.lim_x_low, view.lim_x_high);
    m.yc = clamp(m.yn, view.lim_y_low, view.lim_y_high);
    m.inv_norm = S(1) / sqrt(s.quat[0] * s.quat[0] + s.quat[1] * s.quat[1] + s.quat[2] * s.quat[2] + s.quat[3] * s.quat[3]);
    for (int i = 0; i < 4; i++) m.q[i] = s.quat[i] * m.inv_norm;
    const T w = m.q[0], x = m.q[1], y = m.q[2], k = m.q[3];
    m.Rq[0] = S(1) - S(2) * (y * y + k * k); m.Rq[1] = S(2) * (x * y - w * k); m.Rq[2] = S(2) * (x * k + w * y);
    m.Rq[3] = S(2) * (x * y + w * k); m.Rq[4] = S(1) - S(2) * (x * x + k * k); m.Rq[5] = S(2) * (y * k - w * x);
    m.Rq[6] = S(2) * (x * k - w * y); m.Rq[7] = S(2) * (y * k + w * x); m.Rq[8] = S(1) - S(2) * (x * x + y * y);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            m.V[3 * i + j] = (view.R[3 * i] * m.Rq[j] + view.R[3 * i + 1] * m.Rq[3 + j] + view.R[3 * i + 2] * m.Rq[6 + j]) * s.scale[j];
    m.fxz = view.fx * m.inv_z;
    m.fyz = view.fy * m.inv_z;
    m.jx = m.fxz * m.xc;
    m.jy = m.fyz * m.yc;
    for (int j = 0; j < 3; j++) {
        m.a[j] = m.fxz * m.V[j] - m.jx * m.V[6 + j];
        m.b[j] = m.fyz * m.V[3 + j] - m.jy * m.V[6 + j];
    }
    const T aa = dot3(m.a, m.a), bb = dot3(m.b, m.b);
    m.ca = aa + view.low_pass;
    m.cc = bb + view.low_pass;
    m.cb = dot3(m.a, m.b);
    cross(m.a, m.b, m.n);
    // ca·cc − cb² cancels on thin splats. |a×b|² + lp(|a|²+|b|²) + lp² is the same number with positive terms only.
    m.det = dot3(m.n, m.n) + view.low_pass * (aa + bb) + view.low_pass * view.low_pass;
}

template <class T, class S>
inline __attribute__((always_inline)) Footprint<T> project(const View<S>& view, const Shape<T>& s, T safe_z_floor) {
    Intermediate<T> m;
    intermediate(view, s, safe_z_floor, m);
    Footprint<T> f;
    f.u = view.fx * m.xn + view.cx;
    f.v = view.fy * m.yn + view.cy;
    f.z = m.p[2];
    f.l3 = S(1) / sqrt(m.cc);
    const T inv_sqrt_det = S(1) / sqrt(m.det);
    f.l1 = sqrt(m.cc) * inv_sqrt_det;
    f.l2 = -(m.cb * f.l3 * inv_sqrt_det);
    f.var_u = m.ca;
    f.var_v = m.cc;
    return f;
}

// Set the slopes of a projected footprint: the covariance of depth and image position times the inverse of the
// covariance in the image (RaDe-GS).
template <class T, class S>
inline __attribute__((always_inline)) void add_slopes(const View<S>& view, const Shape<T>& s, T safe_z_floor, Footprint<T>& f) {
    Intermediate<T> m;
    intermediate(view, s, safe_z_floor, m);
    const T with_u = dot3(m.a, m.V + 6), with_v = dot3(m.b, m.V + 6), along = f.l1 * with_u + f.l2 * with_v;
    f.slope_u = f.l1 * along;
    f.slope_v = f.l2 * along + f.l3 * f.l3 * with_v;
}

// Propagate a gradient on the footprint to the splat and, as a left twist (ρ, φ), to the pose (CG-SLAM §2.1). The
// slopes depend on the pose by the path of the covariance. SLOPES: whether they have a gradient.
template <bool SLOPES = false, class T, class S>
inline __attribute__((always_inline)) void project_backward(
    const View<S>& view, const Shape<T>& s, T safe_z_floor, const FootprintGradient<T>& g, ShapeGradient<T>& out) {
    Intermediate<T> m;
    intermediate(view, s, safe_z_floor, m);
    const T l3 = S(1) / sqrt(m.cc), inv_sqrt_det = S(1) / sqrt(m.det);
    const T l1 = sqrt(m.cc) * inv_sqrt_det, l2 = -(m.cb * l3 * inv_sqrt_det);
    T g_l1 = g.l1, g_l2 = g.l2, g_l3 = g.l3, g_with_u, g_with_v;
    if constexpr (SLOPES) {
        const T with_u = dot3(m.a, m.V + 6), with_v = dot3(m.b, m.V + 6), along = l1 * with_u + l2 * with_v;
        const T g_along = g.slope_u * l1 + g.slope_v * l2;
        g_l1 = g_l1 + g.slope_u * along + g_along * with_u;
        g_l2 = g_l2 + g.slope_v * along + g_along * with_v;
        g_l3 = g_l3 + S(2) * l3 * with_v * g.slope_v;
        g_with_u = g_along * l1;
        g_with_v = g_along * l2 + l3 * l3 * g.slope_v;
    }
    // (l1, l2, l3) → (det, cb, cc) → rows a, b of A
    const T g_det = -(g_l1 * l1 + g_l2 * l2) / (S(2) * m.det);
    const T g_cb = -(g_l2 * l3 * inv_sqrt_det);
    const T g_cc = (g_l1 * l1 - g_l2 * l2 - g_l3 * l3) / (S(2) * m.cc);
    T bn[3], na[3], ga[3], gb[3];
    cross(m.b, m.n, bn);
    cross(m.n, m.a, na);
    for (int j = 0; j < 3; j++) {
        ga[j] = S(2) * g_det * (bn[j] + view.low_pass * m.a[j]) + g_cb * m.b[j];
        gb[j] = S(2) * g_det * (na[j] + view.low_pass * m.b[j]) + g_cb * m.a[j] + S(2) * g_cc * m.b[j];
    }
    if constexpr (SLOPES)
        for (int j = 0; j < 3; j++) {
            ga[j] = ga[j] + g_with_u * m.V[6 + j];
            gb[j] = gb[j] + g_with_v * m.V[6 + j];
        }
    // A = J·V: gradients of V and of the entries of J
    T gV[9];
    for (int j = 0; j < 3; j++) {
        gV[j] = m.fxz * ga[j];
        gV[3 + j] = m.fyz * gb[j];
        gV[6 + j] = -(m.jx * ga[j] + m.jy * gb[j]);
        if constexpr (SLOPES) gV[6 + j] = gV[6 + j] + (g_with_u * m.a[j] + g_with_v * m.b[j]);
    }
    const T g_fxz = dot3(ga, m.V), g_jx = -dot3(ga, m.V + 6), g_fyz = dot3(gb, m.V + 3), g_jy = -dot3(gb, m.V + 6);
    const auto free_x = both(ge(m.xn, m.xc), ge(m.xc, m.xn)), free_y = both(ge(m.yn, m.yc), ge(m.yc, m.yn));
    const T two = m.inv_z * S(0) + S(2), one = m.inv_z * S(0) + S(1);
    const T inv_z2 = m.inv_z * m.inv_z;
    T cov[3];                              // h of CG-SLAM §2.1
    cov[0] = only(free_x, g_jx * view.fx * inv_z2);
    cov[1] = only(free_y, g_jy * view.fy * inv_z2);
    cov[2] = -((g_fxz * view.fx + g_fyz * view.fy) * inv_z2)
             - (select(free_x, two, one) * g_jx * m.jx + select(free_y, two, one) * g_jy * m.jy) * m.inv_z;
    T mean[3] = {g.u * m.fxz, g.v * m.fyz, -((g.u * m.fxz * m.xn + g.v * m.fyz * m.yn))};
    T all[3], pose[3];
    for (int i = 0; i < 3; i++) {
        all[i] = mean[i] + cov[i];
        pose[i] = view.pose_mean * mean[i] + view.pose_covariance * cov[i];
    }
    all[2] = all[2] + g.z;
    pose[2] = pose[2] + view.pose_depth * g.z;
    // Pose: ρ = g_p, φ = p × g_p + Σ_j V_j × gV_j
    T turn[3];
    cross(m.p, pose, turn);
    for (int i = 0; i < 3; i++) out.twist[i] = pose[i];
    for (int i = 0; i < 3; i++) out.twist[3 + i] = turn[i];
    for (int j = 0; j < 3; j++) {
        const T vj[3] = {m.V[j], m.V[3 + j], m.V[6 + j]}, gj[3] = {gV[j], gV[3 + j], gV[6 + j]};
        cross(vj, gj, turn);
        for (int i = 0; i < 3; i++) out.twist[3 + i] = out.twist[3 + i] + view.pose_covariance * turn[i];
    }
    // Splat: mean, scale, quaternion
    for (int k = 0; k < 3; k++) out.mean[k] = view.R[k] * all[0] + view.R[3 + k] * all[1] + view.R[6 + k] * all[2];
    T gM[9], G[9];                         // M = Rq·diag(s), G = ∂L/∂Rq
    for (int k = 0; k < 3; k++)
        for (int j = 0; j < 3; j++) gM[3 * k + j] = view.R[k] * gV[j] + view.R[3 + k] * gV[3 + j] + view.R[6 + k] * gV[6 + j];
    for (int j = 0; j < 3; j++) out.scale[j] = m.Rq[j] * gM[j] + m.Rq[3 + j] * gM[3 + j] + m.Rq[6 + j] * gM[6 + j];
    for (int k = 0; k < 3; k++)
        for (int j = 0; j < 3; j++) G[3 * k + j] = gM[3 * k + j] * s.scale[j];
    const T w = m.q[0], x = m.q[1], y = m.q[2], k = m.q[3];
    T d[4];
    d[0] = S(2) * (k * (G[3] - G[1]) + y * (G[2] - G[6]) + x * (G[7] - G[5]));
    d[1] = S(2) * (y * (G[1] + G[3]) + k * (G[2] + G[6]) + w * (G[7] - G[5]) - S(2) * x * (G[4] + G[8]));
    d[2] = S(2) * (x * (G[1] + G[3]) + k * (G[5] + G[7]) + w * (G[2] - G[6]) - S(2) * y * (G[0] + G[8]));
    d[3] = S(2) * (x * (G[2] + G[6]) + y * (G[5] + G[7]) + w * (G[3] - G[1]) - S(2) * k * (G[0] + G[4]));
    const T radial = d[0] * w + d[1] * x + d[2] * y + d[3] * k;
    for (int i = 0; i < 4; i++) out.quat[i] = (d[i] - radial * m.q[i]) * m.inv_norm;
}
