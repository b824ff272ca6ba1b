// What a camera saw at another time than its images were read. data/readout.py is the description.

using Points = Point3<vf>;
struct Places { vf column, row; };
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

// Write the depth [height, width] that the camera saw in the middle of colour, and to color_at [2, height, width] the
// column and row at which colour shows it. If color_at is null: the depth that it saw when a pixel's row of colour was
// read; beyond the depth image it is that of its border.
static void read_before(DepthImage d, Readout r, ReadRules o, float* before, float* color_at) {
    const Pinhole c = {float(d.fx), float(d.fy), float(d.cx), float(d.cy)};
    const vf zero = splat(0.f), usual = splat(o.usual_m);
    const bool of_its_row = !color_at;
    const auto share = [&](vf row) { return (row + 0.5f) * (1.f / d.height) - 0.5f; };
    const auto put = [](float* to, vf a, int lanes) { memcpy(to, &a, lanes * sizeof(float)); };
    for (int y = 0; y < d.height; y++)
        for (int x = 0; x < d.width; x += W) {
            const size_t i = size_t(y) * d.width + x;
            const int lanes = d.width - x < W ? d.width - x : W;
            const Places here = {lane_index() + float(x), splat(float(y))};
            const vf color_s = share(here.row) * (of_its_row ? r.gray_rows_s : 0.f);
            vf z = zero;
            memcpy(&z, d.depth + i, lanes * sizeof(float));
            Places at = here;
            for (int round = 0; round < o.rounds; round++) {
                const vf late_s = r.late_s + r.depth_rows_s * share(at.row) - color_s;
                at = seen_at(c, moved(point_at(c, here, select(gt(z, zero), z, usual)), r.rate, -late_s));
                if (of_its_row) at = {clamp(at.column, 0.f, float(d.width - 1)), clamp(at.row, 0.f, float(d.height - 1))};
                const vf read = between_readings(d, at, o.same_surface);
                z = only(gt(read, zero), moved(point_at(c, at, read), r.rate, late_s).z);
            }
            put(before + i, max(z, zero), lanes);
            if (!color_at) continue;
            const Points point = point_at(c, here, select(gt(z, zero), z, usual));
            at = here;
            for (int round = 0; round < o.rounds; round++) at = seen_at(c, moved(point, r.rate, -r.gray_rows_s * share(at.row)));
            put(color_at + i, at.column, lanes);
            put(color_at + size_t(d.height) * d.width + i, at.row, lanes);
        }
}
