// Resize a camera image, and lay it out for the fits. data/images.py, fit/cpu.py and fit/target.py hold the
// definitions.

// Every second lane of 2W values, from `FIRST` on.
template <int FIRST, int... L> SIGMA_INLINE vf every_second(vf a, vf b, std::integer_sequence<int, L...>) {
    return __builtin_shufflevector(a, b, (2 * L + FIRST)...);
}
SIGMA_INLINE vf evens(vf a, vf b) { return every_second<0>(a, b, std::make_integer_sequence<int, W>{}); }
SIGMA_INLINE vf odds(vf a, vf b) { return every_second<1>(a, b, std::make_integer_sequence<int, W>{}); }

// Channel C of W pixels of three channels.
template <int C, int... L> SIGMA_INLINE vf channel(vf a, vf b, vf c, std::integer_sequence<int, L...>) {
    const vf first = __builtin_shufflevector(a, b, (3 * L + C < 2 * W ? 3 * L + C : 0)...);
    return __builtin_shufflevector(first, c, (3 * L + C < 2 * W ? L : 3 * L + C - W)...);
}
struct Pixels { vf red, green, blue; };
SIGMA_INLINE Pixels load_pixels(const float* p) {
    constexpr auto lanes = std::make_integer_sequence<int, W>{};
    const vf a = load(p), b = load(p + W), c = load(p + 2 * W);
    return {channel<0>(a, b, c, lanes), channel<1>(a, b, c, lanes), channel<2>(a, b, c, lanes)};
}

static void halve_color(const float* color, int width, int height, float* half) {
    const int n = 6 * width;                           // floats in a row of the source
    static thread_local Buffer<float> means;          // each thread that calls has its own
    float* row = means.reserve(n + W);
    for (int y = 0; y < height; y++, half += 3 * width) {
        const float *top = color + size_t(2 * y) * n, *bottom = top + n;
        int i = 0;
        for (; i + 3 + W <= n; i += W)                 // sums of each pixel and the next one; every second is used
            store(row + i, clamp(((load(top + i) + load(top + i + 3)) + (load(bottom + i) + load(bottom + i + 3))) * 0.25f, 0.f, 1.f));
        for (; i + 3 < n; i++) {
            const float mean = ((top[i] + top[i + 3]) + (bottom[i] + bottom[i + 3])) * 0.25f;
            row[i] = mean < 0.f ? 0.f : mean > 1.f ? 1.f : mean;
        }
        for (int x = 0; x + 1 < width; x++) memcpy(half + 3 * x, row + 6 * x, 16);     // the fourth is overwritten
        memcpy(half + 3 * (width - 1), row + 6 * (width - 1), 12);
    }
}

// W columns of a row of the source, from column x of the resized image on.
template <bool HALF, bool SECOND> SIGMA_INLINE vf columns_at(const float* row, const int* table, int x) {
    if constexpr (HALF) return SECOND ? odds(load(row + 2 * x), load(row + 2 * x + W)) : evens(load(row + 2 * x), load(row + 2 * x + W));
    else return gather(row, load(table + x));
}

// The readings nearest to the centres of a row of pixels; a missing one is replaced by another one of the area.
template <bool HALF> static void nearest_readings(const float* depth, const ResizedAxis& rows, const ResizedAxis& columns, const AreaOrder& area, int y, float* out) {
    const float* row = depth + size_t(rows.nearest[y]) * columns.source;
    int x = 0;
    for (; x + W <= columns.size; x += W) store(out + x, columns_at<HALF, true>(row, columns.nearest, x));
    for (; x < columns.size; x++) out[x] = row[columns.nearest[x]];
    for (x = 0; x < columns.size; x++)
        for (int k = 0; k < area.count && out[x] == 0.f; k++)
            out[x] = depth[size_t(area.rows[k * rows.size + y]) * columns.source + area.columns[k * columns.size + x]];
}

template <bool HALF> static void resize_depth_rows(const float* depth, const ResizedAxis& rows, const ResizedAxis& columns, float same_surface, const AreaOrder& area, const DepthRange& range, float* out) {
    for (int y = 0; y < rows.size; y++, out += columns.size) {
        nearest_readings<HALF>(depth, rows, columns, area, y, out);
        const float *top = depth + size_t(rows.first[y]) * columns.source, *bottom = depth + size_t(rows.second[y]) * columns.source;
        const float down = rows.share[y];
        int x = 0;
        for (; x + W <= columns.size; x += W) {
            const vf a = columns_at<HALF, false>(top, columns.first, x), b = columns_at<HALF, true>(top, columns.second, x),
                     c = columns_at<HALF, false>(bottom, columns.first, x), d = columns_at<HALF, true>(bottom, columns.second, x);
            const vf least = min(min(a, b), min(c, d)), most = max(max(a, b), max(c, d)), otherwise = load(out + x), right = load(columns.share + x);
            const Mask smooth = both(both(gt(least, splat(0.f)), gt(same_surface * least, most)), gt(otherwise, splat(0.f)));
            const vf above = a + right * (b - a), below = c + right * (d - c), found = select(smooth, above + down * (below - above), otherwise);
            store(out + x, only(both(ge(found, splat(range.least_m)), ge(splat(range.most_m), found)), found));
        }
        for (; x < columns.size; x++) {
            const float a = top[columns.first[x]], b = top[columns.second[x]], c = bottom[columns.first[x]], d = bottom[columns.second[x]];
            const float ab = a < b ? a : b, cd = c < d ? c : d, least = ab < cd ? ab : cd;
            const float AB = a > b ? a : b, CD = c > d ? c : d, most = AB > CD ? AB : CD;
            const bool smooth = least > 0.f && same_surface * least > most && out[x] > 0.f;
            const float above = a + columns.share[x] * (b - a), below = c + columns.share[x] * (d - c);
            const float found = smooth ? above + down * (below - above) : out[x];
            out[x] = found >= range.least_m && found <= range.most_m ? found : 0.f;
        }
    }
}
static void resize_depth(const float* depth, ResizedAxis rows, ResizedAxis columns, float same_surface, AreaOrder area, DepthRange range, float* resized) {
    const bool half = columns.source == 2 * columns.size;     // then a column reads columns 2x and 2x + 1
    (half ? resize_depth_rows<true> : resize_depth_rows<false>)(depth, rows, columns, same_surface, area, range, resized);
}

static int64_t image_planes(const float* color, const float* depth, int width, int height, int rows, int columns, float* color_planes, float* depth_plane) {
    const size_t plane = size_t(rows) * columns;
    const auto plane_of = [&](int p) { return p < 3 ? color_planes + p * plane : depth_plane; };
    int64_t readings = 0;
    for (int y = 0; y < height; y++, color += 3 * width, depth += width) {
        const size_t at = size_t(y) * columns;
        int x = 0;
        for (; x + W <= width; x += W) {
            const Pixels p = load_pixels(color + 3 * x);
            store(color_planes + at + x, p.red);
            store(color_planes + plane + at + x, p.green);
            store(color_planes + 2 * plane + at + x, p.blue);
        }
        for (; x < width; x++)
            for (int c = 0; c < 3; c++) color_planes[c * plane + at + x] = color[3 * x + c];
        memcpy(depth_plane + at, depth, width * sizeof(float));
        for (int i = 0; i < width; i++) readings += depth[i] > 0.f;
        for (int p = 0; p < 4; p++) memset(plane_of(p) + at + width, 0, (columns - width) * sizeof(float));
    }
    for (int p = 0; p < 4; p++) memset(plane_of(p) + size_t(height) * columns, 0, size_t(rows - height) * columns * sizeof(float));
    return readings;
}

static void gray(const float* color, int64_t pixels, float red, float green, float blue, float* out) {
    int64_t i = 0;
    for (; i + W <= pixels; i += W) {
        const Pixels p = load_pixels(color + 3 * i);
        store(out + i, (p.red * red + p.green * green) + p.blue * blue);
    }
    for (; i < pixels; i++) out[i] = (color[3 * i] * red + color[3 * i + 1] * green) + color[3 * i + 2] * blue;
}

static void halve(const float* image, int width, int height, float* half) {
    const int w = width / 2;
    for (int y = 0; y < height / 2; y++, half += w) {
        const float *top = image + size_t(2 * y) * width, *bottom = top + width;
        int x = 0;
        for (; x + W <= w; x += W) {
            const vf a = load(top + 2 * x), b = load(top + 2 * x + W), c = load(bottom + 2 * x), d = load(bottom + 2 * x + W);
            store(half + x, (((evens(a, b) + odds(a, b)) + evens(c, d)) + odds(c, d)) * 0.25f);
        }
        for (; x < w; x++) half[x] = (((top[2 * x] + top[2 * x + 1]) + bottom[2 * x]) + bottom[2 * x + 1]) * 0.25f;
    }
}

static void halve_depth(const float* depth, int width, int height, float step_m, float* half) {
    const int w = width / 2;
    const float infinite = __builtin_inff();
    for (int y = 0; y < height / 2; y++, half += w) {
        const float *top = depth + size_t(2 * y) * width, *bottom = top + width;
        int x = 0;
        for (; x + W <= w; x += W) {
            const vf t0 = load(top + 2 * x), t1 = load(top + 2 * x + W), b0 = load(bottom + 2 * x), b1 = load(bottom + 2 * x + W);
            const vf cell[4] = {evens(t0, t1), odds(t0, t1), evens(b0, b1), odds(b0, b1)};
            vf sum = cell[0], far = cell[0], near = splat(infinite), n = splat(0.f);
            for (int k = 0; k < 4; k++) {
                const Mask read = gt(cell[k], splat(0.f));
                if (k) { sum = sum + cell[k]; far = max(far, cell[k]); }
                near = min(near, select(read, cell[k], splat(infinite)));
                n = n + only(read, splat(1.f));
            }
            store(half + x, only(both(gt(n, splat(1.f)), gt(splat(step_m), far - near)), sum / max(n, splat(1.f))));
        }
        for (; x < w; x++) {
            const float cell[4] = {top[2 * x], top[2 * x + 1], bottom[2 * x], bottom[2 * x + 1]};
            float sum = cell[0], far = cell[0], near = infinite, n = 0.f;
            for (int k = 0; k < 4; k++) {
                if (k) { sum = sum + cell[k]; far = cell[k] > far ? cell[k] : far; }
                if (cell[k] > 0.f) { near = cell[k] < near ? cell[k] : near; n = n + 1.f; }
            }
            half[x] = n > 1.f && far - near < step_m ? sum / n : 0.f;
        }
    }
}
