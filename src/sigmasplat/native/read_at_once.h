// What a camera saw at another time than its images were read. data/read_at_once.py is the description.

struct Points { vf x, y, z; };
struct Places { vf column, row; };
// Points in a camera after it has moved for a time, to second order.
SIGMA_INLINE Points after(const Points& p, const float* rate, vf time_s) {
    const float *v = rate, *w = rate + 3;
    const vf dx = v[0] + (w[1] * p.z - w[2] * p.y), dy = v[1] + (w[2] * p.x - w[0] * p.z), dz = v[2] + (w[0] * p.y - w[1] * p.x), half = 0.5f * time_s;
    return {p.x - time_s * (dx - half * (w[1] * dz - w[2] * dy)), p.y - time_s * (dy - half * (w[2] * dx - w[0] * dz)),
            p.z - time_s * (dz - half * (w[0] * dy - w[1] * dx))};
}

struct Pinhole { float fx, fy, cx, cy; };
SIGMA_INLINE Points point_at(const Pinhole& c, const Places& at, vf z) { return {(at.column - c.cx) * (1.f / c.fx) * z, (at.row - c.cy) * (1.f / c.fy) * z, z}; }
SIGMA_INLINE Places seen_at(const Pinhole& c, const Points& p) {
    const vf per_z = 1.f / max(p.z, splat(1e-3f));
    return {c.fx * (p.x * per_z) + c.cx, c.fy * (p.y * per_z) + c.cy};
}

// The depth between four neighbours: interpolated on a surface, else that of the nearest pixel; 0 beyond the image.
SIGMA_INLINE vf between_readings(const DepthImage& d, const Places& at, float same_surface) {
    const float right = float(d.width - 1), bottom = float(d.height - 1);
    const vf left = clamp(floor(at.column), 0.f, right), top = clamp(floor(at.row), 0.f, bottom);
    const vf next_left = clamp(left + 1.f, 0.f, right), next_top = clamp(top + 1.f, 0.f, bottom);
    const vf a = clamp(at.column - left, 0.f, 1.f), c = clamp(at.row - top, 0.f, 1.f), half = splat(0.5f);
    const vi above = to_int(top) * d.width, below = to_int(next_top) * d.width, x = to_int(left), next = to_int(next_left);
    const vf v00 = gather(d.depth, above + x), v10 = gather(d.depth, above + next), v01 = gather(d.depth, below + x), v11 = gather(d.depth, below + next);
    const vf nearest = select(gt(c, half), select(gt(a, half), v11, v01), select(gt(a, half), v10, v00));
    const vf least = min(min(v00, v10), min(v01, v11)), most = max(max(v00, v10), max(v01, v11));
    const vf upper = v00 + a * (v10 - v00), lower = v01 + a * (v11 - v01);
    const vf between = select(gt(same_surface * least, most - least), upper + c * (lower - upper), nearest);
    const Mask inside = both(both(ge(at.column, -half), gt(right + half, at.column)), both(ge(at.row, -half), gt(bottom + half, at.row)));
    return only(both(inside, gt(nearest, splat(0.f))), between);
}

// Write the depth [height, width] that the camera saw when a pixel's row of colour was read (of_color; beyond the depth
// image that of its border), or in the middle of colour. color_at: null, or [2, height, width]: column and row at which
// colour shows what was seen then.
static void read_before(DepthImage d, Readout r, ReadRules o, float* before, float* color_at) {
    const Pinhole c = {float(d.fx), float(d.fy), float(d.cx), float(d.cy)};
    const vf zero = splat(0.f), usual = splat(float(o.usual_m));
    const auto share = [&](vf row) { return (row + 0.5f) * (1.f / d.height) - 0.5f; };
    const auto put = [](float* to, vf a, int lanes) { memcpy(to, &a, lanes * sizeof(float)); };
    for (int y = 0; y < d.height; y++)
        for (int x = 0; x < d.width; x += W) {
            const size_t i = size_t(y) * d.width + x;
            const int lanes = d.width - x < W ? d.width - x : W;
            const Places here = {lane_index() + float(x), splat(float(y))};
            const vf of_color = share(here.row) * (o.of_color ? r.gray_rows_s : 0.f);
            vf z = zero;
            memcpy(&z, d.depth + i, lanes * sizeof(float));
            Places at = here;
            for (int round = 0; round < o.rounds; round++) {
                const vf late_s = r.late_s + r.depth_rows_s * share(at.row) - of_color;
                at = seen_at(c, after(point_at(c, here, select(gt(z, zero), z, usual)), r.rate, late_s));
                if (o.of_color) at = {clamp(at.column, 0.f, float(d.width - 1)), clamp(at.row, 0.f, float(d.height - 1))};
                const vf read = between_readings(d, at, float(o.same_surface));
                z = only(gt(read, zero), after(point_at(c, at, read), r.rate, -late_s).z);
            }
            put(before + i, max(z, zero), lanes);
            if (!color_at) continue;
            const Points point = point_at(c, here, select(gt(z, zero), z, usual));
            at = here;
            for (int round = 0; round < o.rounds; round++) at = seen_at(c, after(point, r.rate, r.gray_rows_s * share(at.row)));
            put(color_at + i, at.column, lanes);
            put(color_at + size_t(d.height) * d.width + i, at.row, lanes);
        }
}
