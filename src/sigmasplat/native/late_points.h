// Where points are in a camera that moves. Numbers are vectors of lanes (lanes.h), or single. Has no includes and no
// namespace.
template <class V> struct Point3 { V x, y, z; };

// Points moved by a twist (v, ω) per second for a time, to second order; in a camera that moves so itself, -time_s.
template <class V> SIGMA_INLINE Point3<V> moved(const Point3<V>& p, const float* rate, V time_s) {
    const float *v = rate, *w = rate + 3;
    const V dx = v[0] + (w[1] * p.z - w[2] * p.y), dy = v[1] + (w[2] * p.x - w[0] * p.z), dz = v[2] + (w[0] * p.y - w[1] * p.x), half = 0.5f * time_s;
    return {p.x + time_s * (dx + half * (w[1] * dz - w[2] * dy)), p.y + time_s * (dy + half * (w[2] * dx - w[0] * dz)),
            p.z + time_s * (dz + half * (w[0] * dy - w[1] * dx))};
}
