// Compare the surfaces and gray values of two images at a motion, in double precision. fit/compare.py is the
// description and the definition.

// The value of rank k of n numbers, by quickselect; the numbers before it are then at most as large.
static double ranked(double* v, int64_t n, int64_t k) {
    int64_t low = 0, high = n - 1;
    while (low < high) {
        const double pivot = v[low + (high - low) / 2];
        int64_t i = low, j = high;
        while (i <= j) {
            while (v[i] < pivot) i++;
            while (v[j] > pivot) j--;
            if (i <= j) { const double t = v[i]; v[i++] = v[j]; v[j--] = t; }
        }
        if (k <= j) high = j;
        else if (k >= i) low = i;
        else break;
    }
    return v[k];
}
static double median(double* v, int64_t n) {
    const double upper = ranked(v, n, n / 2);
    if (n % 2) return upper;
    double lower = v[0];
    for (int64_t i = 1; i < n / 2; i++) lower = v[i] > lower ? v[i] : lower;
    return 0.5 * (lower + upper);
}

SIGMA_INLINE double noise_m(double z, const CompareRules& o) { return o.noise_relative * (z * z) + o.noise_m; }
SIGMA_INLINE float seen_depth(float z, const CompareRules& o) { return z >= float(o.hidden_m) ? 0.f : z; }

static double noise_scale(const float* depth, int width, int height, CompareRules o) {
    const int last = (width - 2) / o.step * o.step;
    static thread_local Buffer<double> bends;         // each thread that calls has its own
    double* bend = bends.reserve(size_t(height / o.step + 1) * (width / o.step + 1));
    int64_t n = 0;
    for (int y = 0; y < height; y += o.step)
        for (int x = 0; x < last; x += o.step) {
            const float* at = depth + size_t(y) * width + x;
            const float left = seen_depth(at[0], o), middle = seen_depth(at[1], o), right = seen_depth(at[2], o);
            if (!(left > 0.f && middle > 0.f && right > 0.f)) continue;
            bend[n++] = double(__builtin_fabsf(middle - 0.5f * (left + right))) / noise_m(middle, o);
        }
    if (n < o.least_pixels) return 1.0;
    const double scale = median(bend, n) / (1.2247 * 0.6745);    // fit/compare.py `noise_scale` says why
    return scale > 1.0 ? scale : 1.0;
}

// A point of the reference that falls on a live reading: the depth difference, its standard deviation, and the gray values.
struct Point { double difference, noise; float reference, live; };

// Find the live reading next to (column, row) that is closest to the expected depth; infinite without one.
SIGMA_INLINE double nearest_difference(const ComparedImages& c, const CompareRules& o, int left, int top, double expected) {
    double best = __builtin_inf();
    for (int k = 0; k < 4; k++) {
        const float reading = seen_depth(c.live_depth[size_t(top + k / 2) * c.width + left + k % 2], o);
        const double difference = double(reading) - expected;
        if (reading > 0.f && __builtin_fabs(difference) < __builtin_fabs(best)) best = difference;
    }
    return best;
}

static double correlation(const Point* points, int64_t n, double flat) {
    double mean[2] = {}, square[2] = {}, product = 0;
    for (int64_t i = 0; i < n; i++) { mean[0] += points[i].reference; mean[1] += points[i].live; }
    mean[0] /= double(n);
    mean[1] /= double(n);
    for (int64_t i = 0; i < n; i++) {
        const double a = points[i].reference - mean[0], b = points[i].live - mean[1];
        square[0] += a * a;
        square[1] += b * b;
        product += a * b;
    }
    const double one = __builtin_sqrt(square[0] / double(n)), other = __builtin_sqrt(square[1] / double(n));
    return (one < other ? one : other) > flat ? product / double(n) / (one * other) : __builtin_nan("");
}

// Write the comparison of `count` points to `found`; comparable: number of readings of the reference that nothing hides.
static void judge(Point* points, int64_t count, int64_t comparable, int64_t live_readings, const CompareRules& o, double* found) {
    int64_t close = 0, front = 0, behind = 0, kept = 0;
    static thread_local Buffer<double> errors;
    double* error = errors.reserve(count);
    for (int64_t i = 0; i < count; i++) {
        const Point p = points[i];
        const double limit = o.close_sigma * p.noise + o.close_m, size = __builtin_fabs(p.difference);
        close += size < limit;
        behind += p.difference >= limit;
        if (p.difference <= -limit) { front++; continue; }
        error[kept] = size / p.noise;
        points[kept++] = p;
    }
    const bool few = kept < o.least_pixels;
    const double n = double(count), covered = n / double(live_readings > 1 ? live_readings : 1);
    const double values[COMPARED] = {
        n / double(comparable), double(close) / n, double(front) / n, double(behind) / n, few ? __builtin_inf() : median(error, kept),
        few ? __builtin_nan("") : correlation(points, kept, o.flat), n, covered < 1.0 ? covered : 1.0};
    memcpy(found, values, sizeof values);
}

using Position = Point3<double>;
SIGMA_INLINE Position transformed(const double* T, const Position& p) {
    return {T[0] * p.x + T[1] * p.y + T[2] * p.z + T[3], T[4] * p.x + T[5] * p.y + T[6] * p.z + T[7], T[8] * p.x + T[9] * p.y + T[10] * p.z + T[11]};
}
struct Pixel { double column, row; };
SIGMA_INLINE Pixel projected(const ComparedImages& c, const Position& p) {
    const double ahead = p.z > 1e-3 ? p.z : 1e-3;
    return {c.fx * p.x / ahead + c.cx, c.fy * p.y / ahead + c.cy};
}
SIGMA_INLINE bool in_view(const ComparedImages& c, const Position& p, const Pixel& at) {
    return p.z > 0.05 && at.column >= 0 && at.row >= 0 && at.column < c.width - 1 && at.row < c.height - 1;
}
SIGMA_INLINE size_t nearest_to(const ComparedImages& c, const Pixel& at) {
    const int left = int(at.column), top = int(at.row);
    return size_t(top + (at.row - top > 0.5)) * c.width + left + (at.column - left > 0.5);
}
// The live position of a reference pixel whose row was read late: as the live row that shows it was.
SIGMA_INLINE Position read_late(const ComparedImages& c, const double* T, const Position& p, int v, const AlignReadouts& r, bool depth) {
    const auto late_s = [&](const Readout& image, double row) {
        return (depth ? image.late_s : 0.f) + (depth ? image.depth_rows_s : image.gray_rows_s) * ((row + 0.5) / c.height - 0.5);
    };
    const Position live = transformed(T, moved(p, r.reference.rate, late_s(r.reference, v)));
    const Position shown = moved(live, r.live.rate, -late_s(r.live, projected(c, live).row));
    return moved(live, r.live.rate, -late_s(r.live, projected(c, shown).row));    // the row is another one when it is read
}

static bool compare(ComparedImages c, const double* T, const AlignReadouts* readouts, CompareRules o, double* found) {
    const double scale = noise_scale(c.live_depth, c.width, c.height, o);
    static thread_local Buffer<Point> found_points;
    Point* points = found_points.reserve(size_t((c.height + o.step - 1) / o.step) * ((c.width + o.step - 1) / o.step));
    int64_t readings = 0, inside = 0, hidden = 0, count = 0, live_readings = 0;
    for (int v = 0; v < c.height; v += o.step)
        for (int u = 0; u < c.width; u += o.step) {
            const size_t at = size_t(v) * c.width + u;
            live_readings += seen_depth(c.live_depth[at], o) != 0.f;
            const double z = c.reference_depth[at];
            if (!(z > 0.0)) continue;
            readings++;
            const Position point = {(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z};
            const Position live = readouts ? read_late(c, T, point, v, *readouts, true) : transformed(T, point);
            const Pixel pixel = projected(c, live);
            if (!in_view(c, live, pixel)) continue;
            inside++;
            const int left = int(pixel.column), top = int(pixel.row);
            const double difference = nearest_difference(c, o, left, top, live.z);
            if (!(__builtin_fabs(difference) < __builtin_inf())) {
                hidden += c.live_depth[size_t(top) * c.width + left] >= float(o.hidden_m);
                continue;
            }
            Pixel gray = pixel;
            if (readouts) {
                const double y = c.color_depth ? c.color_depth[at] : z;
                const Position seen = read_late(c, T, {(u - c.cx) / c.fx * y, (v - c.cy) / c.fy * y, y}, v, *readouts, false);
                if (in_view(c, seen, projected(c, seen))) gray = projected(c, seen);
            }
            const size_t nearest = nearest_to(c, gray);
            points[count++] = {difference, noise_m(live.z, o) * scale, c.reference_gray[at], c.live_gray[nearest]};
        }
    if (readings < o.least_pixels || inside < o.least_pixels || count < o.least_pixels) return false;
    judge(points, count, readings - hidden, live_readings, o, found);
    return true;
}
