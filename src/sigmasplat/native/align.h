// Direct alignment on a CPU: the normal equations of one step, and the loop. The loop is in C++ because a step takes
// only a tenth of a millisecond. The normal equations are H [21]
// upper triangle, b [6], counts [5], S [21], upper triangle of Σ b_c b_cᵀ over cells c of CELL×CELL pixels, grays [2].
#include "align_loop.h"
#include "late_points.h"
#include "align_pixel.h"
static_assert(CELL % W == 0, "a cell is whole vectors wide");

// A live image with gray and depth of each pixel side by side: one load fetches both of two neighbours.
struct LivePairs { const float* pairs; int width; };
SIGMA_INLINE Neighbours neighbours(const LivePairs& live, vi i) {
    vf above[4], below[4];
    gather_fours(live.pairs, i + i, above);
    gather_fours(live.pairs + 2 * live.width, i + i, below);
    return {{above[0], above[2], below[0], below[2]}, {above[1], above[3], below[1], below[3]}};
}
template <int FROM, int... L> SIGMA_INLINE vf interleaved(vf a, vf b, std::integer_sequence<int, L...>) {
    return __builtin_shufflevector(a, b, (L % 2 * W + FROM + L / 2)...);
}
static LivePairs side_by_side(const AlignLevel& L, Buffer<float>& memory) {
    const int64_t pixels = int64_t(L.width) * L.height;
    float* pairs = memory.reserve(2 * pixels);
    int64_t i = 0;
    for (; i + W <= pixels; i += W) {
        const vf gray = load(L.live_gray + i), depth = load(L.live_depth + i);
        store(pairs + 2 * i, interleaved<0>(gray, depth, std::make_integer_sequence<int, W>{}));
        store(pairs + 2 * i + W, interleaved<W / 2>(gray, depth, std::make_integer_sequence<int, W>{}));
    }
    for (; i < pixels; i++) { pairs[2 * i] = L.live_gray[i]; pairs[2 * i + 1] = L.live_depth[i]; }
    return {pairs, L.width};
}

// The vectors of the rows of a cell that are computed together. Each stage runs over all of them before the next one
// begins: its values fit into the registers, and the processor works on several vectors at once.
constexpr int PART_ROWS = 8, PART = PART_ROWS * CELL / W;
struct Part { Warped warped[PART], gray[PART]; Residuals residuals[PART]; Derivatives derivatives[PART]; size_t at[PART]; int lanes[PART]; };

// The next cells are fetched ahead: a row of a cell is one cache line, too short for the processor to do so by itself.
// Without this, most of the time is spent on waiting for memory. Beyond the end of an image a prefetch does nothing.
constexpr int CELLS_AHEAD = 2;
SIGMA_INLINE void fetch_ahead(const AlignLevel& L, size_t at) {
    for (const float* plane : {L.reference_depth, L.reference_gray, L.weight_gray, L.weight_depth, L.noise, L.color_depth})
        if (plane) __builtin_prefetch(plane + at + CELLS_AHEAD * CELL);
}

SIGMA_INLINE vf load_lanes(const float* p, int lanes) {
    if (lanes == W) return load(p);
    vf r{};
    memcpy(&r, p, lanes * sizeof(float));
    return r;
}
SIGMA_INLINE vf load_lanes(const float* plane, size_t at, int lanes, float otherwise) { return plane ? load_lanes(plane + at, lanes) : splat(otherwise); }

// Warp the pixels of a part; return the number of vectors with a pixel that is used. With times, gray is warped by itself: it
// was read at another time than depth. A pixel is used if both are in view: `linearise` counts on it.
struct Bounds { int left, right, top, bottom; };
struct RowMotions { Motion depth[CELL], gray[CELL]; };       // of the rows of a band
template <bool TIMED> static int warp_part(const AlignLevel& L, const Motion& T, const RowMotions& rows, const AlignReadouts* times, Bounds in, int apart, Part& part) {
    int n = 0;
    for (int y = in.top; y < in.bottom; y++) {
        if (y % apart) continue;
        const Motion &of_depth = TIMED ? rows.depth[y % CELL] : T, &of_gray = rows.gray[y % CELL];
        fetch_ahead(L, size_t(y) * L.width + in.left);
        for (int x = in.left; x < in.right; x += W) {
            const size_t at = part.at[n] = size_t(y) * L.width + x;
            const int lanes = part.lanes[n] = L.width - x < W ? L.width - x : W;
            const Mask inside = gt(splat(float(lanes)), lane_index());
            const vf depth = load_lanes(L.reference_depth + at, lanes), off_x = lane_index() + (float(x) - L.cx);
            const float off_y = float(y) - L.cy;
            if constexpr (TIMED) {
                const vf gray_depth = L.color_depth ? load_lanes(L.color_depth + at, lanes) : depth;
                if (!warp(L, of_gray, gray_depth, off_x, off_y, inside, gray_rows(L, times->live), part.gray[n])) continue;
                if (!warp(L, of_depth, depth, off_x, off_y, inside, depth_rows(L, times->live), part.warped[n])) continue;
                const Mask both_seen = part.warped[n].ok = both(part.warped[n].ok, part.gray[n].ok);
                n += any(both_seen);
            } else n += warp(L, T, depth, off_x, off_y, inside, AtOnce{}, part.warped[n]);
        }
    }
    return n;
}

// Add residuals and derivatives of reference pixels to H and sums (acc) and to b (pull).
template <bool TIMED>
static void add_part(const AlignLevel& L, const LivePairs& live, const AlignOptions& o, const Motion& T, const RowMotions& rows, const AlignReadouts* times, Bounds in, int apart, vf* acc, vf* pull) {
    Part part;
    const int n = warp_part<TIMED>(L, T, rows, times, in, apart, part);
    for (int i = 0; i < n; i++) {
        const Warped& w = part.warped[i];
        const size_t at = part.at[i];
        const int lanes = part.lanes[i];
        __builtin_prefetch(live.pairs + 2 * (w.at[0] + CELLS_AHEAD * CELL));
        const ReferencePixels pixels = {load_lanes(L.reference_gray + at, lanes), load_lanes(L.weight_gray, at, lanes, 1.f),
                                        load_lanes(L.weight_depth, at, lanes, 1.f), load_lanes(L.noise, at, lanes, 1.f)};
        const Neighbours near = neighbours(live, w.at);
        if constexpr (TIMED) part.residuals[i] = compared(o, w, near, part.gray[i], neighbours(live, part.gray[i].at).gray, pixels, acc + MATRIX_TERMS);
        else part.residuals[i] = compared(o, w, near, w, near.gray, pixels, acc + MATRIX_TERMS);
    }
    for (int i = 0; i < n; i++) part.derivatives[i] = derivatives(L, part.warped[i], part.residuals[i]);
    add_rows<0, 1>(part.residuals, part.derivatives, n, acc, pull);
    add_rows<1, 3>(part.residuals, part.derivatives, n, acc, pull);
    add_rows<3, 6>(part.residuals, part.derivatives, n, acc, pull);
}

// So few bands take less time than waking the other threads.
constexpr int FEW_BANDS = 4;

// apart: by every so many rows.
static void linearise(const AlignLevel& L, const LivePairs& live, const AlignOptions& o, const AlignReadouts* times, int apart, const double* T, double* normal) {
    const Motion motion = motion_of(T);
    const int bands = (L.height + CELL - 1) / CELL, cells = (L.width + CELL - 1) / CELL;
    Buffer<double> band_sums;
    band_sums.reserve(size_t(bands) * NORMAL_TERMS);
#pragma omp parallel for schedule(dynamic, 1) if (bands > FEW_BANDS)
    for (int band = 0; band < bands; band++) {
        vf acc[MATRIX_TERMS + SUMS];                  // H and sums; b is summed per cell
        for (auto& a : acc) a = splat(0.f);
        double* total = &band_sums[size_t(band) * NORMAL_TERMS];
        RowMotions rows;
        for (int y = band * CELL; times && y < (band + 1) * CELL; y++) {
            rows.depth[y % CELL] = motion_of_depth_row(L, motion, times->reference, y);
            rows.gray[y % CELL] = motion_of_gray_row(L, motion, times->reference, y);
        }
        for (int cell = 0; cell < cells; cell++) {
            vf pull[6];
            for (auto& a : pull) a = splat(0.f);
            const vf used = acc[22], read = acc[23], agreeing = acc[24];
            const int bottom = (band + 1) * CELL < L.height ? (band + 1) * CELL : L.height, right = (cell + 1) * CELL < L.width ? (cell + 1) * CELL : L.width;
            for (int y = band * CELL; y < bottom; y += PART_ROWS)
                (times ? add_part<true> : add_part<false>)(L, live, o, motion, rows, times, {cell * CELL, right, y, y + PART_ROWS < bottom ? y + PART_ROWS : bottom}, apart, acc, pull);
            double g[6];
            for (int k = 0; k < 6; k++) { g[k] = lane_sum(pull[k]); total[21 + k] += g[k]; }
            // Two counts in one sum, exact below 2²⁴: pixels in view without a reading or agreeing, and readings.
            const int counts = int(lane_sum(fma(splat(4096.f), (acc[22] - used) - (acc[24] - agreeing), acc[23] - read)));
            const int read_here = counts % 4096;
            total[COMMON] += common_pixels(counts / 4096 + read_here, read_here);
            for (int i = 0, q = COMMON + 1; i < 6; i++)
                for (int j = i; j < 6; j++, q++) total[q] += g[i] * g[j];
        }
        for (int k = 0; k < 21; k++) total[k] = lane_sum(acc[k]);
        for (int k = 0; k < COUNTS; k++) total[27 + k] = lane_sum(acc[21 + k]);
        for (int k = 0; k < 2; k++) total[GRAYS + k] = lane_sum(acc[MATRIX_TERMS + COUNTS + k]);
    }
    for (int k = 0; k < NORMAL_TERMS; k++) normal[k] = 0;
    for (int band = 0; band < bands; band++)
        for (int k = 0; k < NORMAL_TERMS; k++) normal[k] += band_sums[size_t(band) * NORMAL_TERMS + k];
}

// The normal equations at `count` motions T [count][16], one after another in `normal`; from motion number `whole` on, by
// fewer rows.
static void align_steps(const AlignLevel* level, const AlignOptions* o, const AlignReadouts* times, int count, int whole, const double* T, double* normal) {
    static thread_local Buffer<float> memory;         // each thread that calls has its own
    const LivePairs live = side_by_side(*level, memory);
    for (int k = 0; k < count; k++) linearise(*level, live, *o, times, k < whole ? 1 : rows_apart(level->height), T + 16 * k, normal + NORMAL_TERMS * k);
}

// times: null if all rows of both images were read at once.
// Align from the coarsest level, `levels[count - 1]`, to the finest. T is the guess on input and the motion on output.
// found: counts of the last or best iterate of the finest level, and the gain. Returns the number of steps.
static int align_images(const AlignLevel* levels, const AlignOptions* options, const AlignReadouts* times, int count, AlignLoop o, double* T, double* found, int* degenerate) {
    double normal[NORMAL_TERMS];
    static thread_local Buffer<float> memory;
    LivePairs live{};
    Descent d = begin_descent(T, count);
    for (int before = count; d.level >= 0 && o.iterations > 0;) {
        const int k = d.level;
        if (k != before) live = side_by_side(levels[before = k], memory);
        AlignOptions in_its_light = options[k];
        in_its_light.gain = float(d.gain);
        linearise(levels[k], live, in_its_light, times, 1, d.T, normal);
        take_step(d, o, normal);
    }
    copy(d.T, 12, T);
    copy(d.sums, COUNTS + 1, found);
    found[COUNTS + 1] = d.gain;
    *degenerate = d.degenerate;
    return d.steps;
}
