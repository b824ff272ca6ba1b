// Find the points in space that a depth image sees to be free, in double precision. tracking/moving/free_space.py is
// the description and the definition.

// Whether the image sees through a point at depth z behind pixel (u, v): there are readings around it, all farther.
SIGMA_INLINE bool sees_through(const DepthImage& d, const FreeRules& o, int u, int v, double z) {
    const double least = z * (1.0 + o.clear_relative) + o.clear_m;
    const float middle = d.depth[size_t(v) * d.width + u];
    if (middle > 0.f && !(least < double(middle))) return false;    // this decides for nearly all points of a still scene
    const int top = v > o.radius_px ? v - o.radius_px : 0, bottom = v + o.radius_px < d.height ? v + o.radius_px : d.height - 1;
    const int left = u > o.radius_px ? u - o.radius_px : 0, right = u + o.radius_px < d.width ? u + o.radius_px : d.width - 1;
    bool read = false;
    for (int y = top; y <= bottom; y++)
        for (int x = left; x <= right; x++) {
            const float reading = d.depth[size_t(y) * d.width + x];
            if (!(reading > 0.f)) continue;
            if (!(least < double(reading))) return false;
            read = true;
        }
    return read;
}

static void free_places(PointColumns p, const double* T, DepthImage d, FreeRules o, uint8_t* free) {
    for (int64_t i = 0; i < p.count; i++) {
        const double X = p.x[i * p.stride], Y = p.y[i * p.stride], Z = p.z[i * p.stride];
        const double x = T[0] * X + T[1] * Y + T[2] * Z + T[3], y = T[4] * X + T[5] * Y + T[6] * Z + T[7], z = T[8] * X + T[9] * Y + T[10] * Z + T[11];
        const double ahead = z > 1e-3 ? z : 1e-3;
        const double u = __builtin_rint(d.fx * x / ahead + d.cx), v = __builtin_rint(d.fy * y / ahead + d.cy);
        const bool inside = z > 0.05 && u >= 0 && v >= 0 && u < d.width && v < d.height;
        free[i] = inside && sees_through(d, o, int(u), int(v), z);
    }
}
