// Image alignment on a GPU: pyramids, normal equations, and steps for which the host does not wait. fit/align.py is the
// definition. Residuals and steps are the source code of the CPU kernels (align_pixel.h, align_loop.h). A block of
// threads processes a cell of CELL×CELL pixels, one pixel per thread.
#include "sums.cuh"

namespace sigmasplat {

// Replaces lanes.h: a vector of one lane.
typedef float vf;
typedef int vi;
typedef bool Mask;
#define SIGMA_INLINE inline
inline vf splat(float a) { return a; }
inline vf load(const float* p) { return *p; }
inline vf fma(vf a, vf b, vf c) { return fmaf(a, b, c); }
inline vf min(vf a, vf b) { return fminf(a, b); }
inline vf max(vf a, vf b) { return fmaxf(a, b); }
inline vf abs(vf a) { return fabsf(a); }
inline vf floor(vf a) { return floorf(a); }
inline vf clamp(vf x, float low, float high) { return fminf(fmaxf(x, low), high); }
inline vi to_int(vf a) { return int(a); }
inline Mask gt(vf a, vf b) { return a > b; }
inline Mask ge(vf a, vf b) { return a >= b; }
inline Mask both(Mask a, Mask b) { return a && b; }
inline Mask mask_or(Mask a, Mask b) { return a || b; }
inline Mask mask_not(Mask a) { return !a; }
inline Mask any(Mask a) { return a; }
inline vf only(Mask mask, vf a) { return mask ? a : 0.f; }
inline vf select(Mask mask, vf a, vf b) { return mask ? a : b; }

#include "align_level.h"
#include "align_loop.h"
#include "late_points.h"
#include "align_pixel.h"

struct LivePlanes { const float *gray, *depth; int width; };
inline Neighbours neighbours(const LivePlanes& live, int i) {
    const float *g = live.gray + i, *d = live.depth + i;
    return {{g[0], g[1], g[live.width], g[live.width + 1]}, {d[0], d[1], d[live.width], d[live.width + 1]}};
}

static_assert(CELL * CELL == THREADS, "a thread for each pixel of a cell");
constexpr int WARPS = THREADS / 32;
constexpr int PULL = MATRIX_TERMS + SUMS, TERMS = PULL + 6, FLOATS = 32;   // per pixel: H, sums, b
constexpr int READ = MATRIX_TERMS + 2, AGREEING = READ + 1;               // both counts of a warp share one float
constexpr float BOTH = 64.f;

// ---- pyramids -------------------------------------------------------------------------------------------------------

struct Averaged { const float *a, *b; };   // planes; both may be null
struct Halved { float *a, *b; };

// Halve images [height, width]: two are averaged over 2×2 cells. Depth is averaged over the readings of a cell; it gets
// no reading if there is only one, or if they do not belong to one surface.
KERNEL halve_images(Averaged from, Halved to, const float* depth, float* half_depth, float step_m,
                    int width, int height) {
    const int w = width / 2, h = height / 2, i = thread_number();
    if (i >= w * h) return;
    const size_t at = size_t(i / w) * 2 * width + i % w * 2, below = at + width;
    if (from.a) to.a[i] = (from.a[at] + from.a[at + 1] + from.a[below] + from.a[below + 1]) / 4.f;
    if (from.b) to.b[i] = (from.b[at] + from.b[at + 1] + from.b[below] + from.b[below + 1]) / 4.f;
    if (!depth) return;
    const float z[4] = {depth[at], depth[at + 1], depth[below], depth[below + 1]};
    float nearest = 1e9f, farthest = 0.f, readings = 0.f;
    for (int k = 0; k < 4; k++) {
        if (!(z[k] > 0.f)) continue;
        nearest = fminf(nearest, z[k]);
        farthest = fmaxf(farthest, z[k]);
        readings += 1.f;
    }
    half_depth[i] = readings > 1.f && farthest - nearest < step_m ? (z[0] + z[1] + z[2] + z[3]) / readings : 0.f;
}

// ---- normal equations -----------------------------------------------------------------------------------------------

// Sum 32 numbers over a warp's lanes in 31 shuffles: in each round, lanes exchange half of their numbers. Lane k
// returns the sum of number k.
template <int HALF> inline float sum_of_lanes(float* values) {
    const bool upper = int(threadIdx.x) & HALF;
    for (int k = 0; k < HALF; k++) {
        const float keep = upper ? values[k + HALF] : values[k], give = upper ? values[k] : values[k + HALF];
        values[k] = keep + __shfl_xor_sync(ALL_LANES, give, HALF);
    }
    if constexpr (HALF > 1) return sum_of_lanes<HALF / 2>(values);
    return values[0];
}

inline int cells_of(const AlignLevel& L) { return (L.width + CELL - 1) / CELL * ((L.height + CELL - 1) / CELL); }

// Store the sums of one cell's pixels in the order of NORMAL_TERMS: float within a warp, double across warps. All
// threads must call this. apart: by every so many rows.
inline void store_cell(const AlignLevel& L, const AlignOptions& o, const AlignReadouts* times, int apart, const double* T, int cell, double* stored) {
    __shared__ float of_warps[WARPS][FLOATS];
    __shared__ double of_cell[TERMS];
    const int thread = int(threadIdx.x), cells_x = (L.width + CELL - 1) / CELL;
    const int x = cell % cells_x * CELL + thread % CELL, y = cell / cells_x * CELL + thread / CELL;
    float terms[TERMS] = {};
    if (x < L.width && y < L.height && y % apart == 0) {
        const size_t at = size_t(y) * L.width + x;
        const ReferencePixels pixel = {L.reference_gray[at], L.weight_gray ? L.weight_gray[at] : 1.f, L.weight_depth ? L.weight_depth[at] : 1.f,
                                       L.noise ? L.noise[at] : 1.f};
        Warped w, gray;
        const Motion motion = motion_of(T);
        const float depth = L.reference_depth[at], off_x = float(x) - L.cx, off_y = float(y) - L.cy;
        const bool used = !times ? warp(L, motion, depth, off_x, off_y, true, AtOnce{}, w)
            : warp(L, motion_of_gray_row(L, motion, times->reference, y), L.color_depth ? L.color_depth[at] : depth, off_x, off_y, true, gray_rows(L, times->live), gray)
                && warp(L, motion_of_depth_row(L, motion, times->reference, y), depth, off_x, off_y, true, depth_rows(L, times->live), w);
        if (used) {
            const LivePlanes live = {L.live_gray, L.live_depth, L.width};
            const Neighbours near = neighbours(live, w.at), of_gray = times ? neighbours(live, gray.at) : near;
            const Residuals r = compared(o, w, near, times ? gray : w, of_gray.gray, pixel, terms + MATRIX_TERMS);
            const Derivatives J = derivatives(L, w, r);
            add_rows<0, 6>(&r, &J, 1, terms, terms + PULL);
        }
    }
    terms[READ] = fmaf(BOTH, terms[READ], terms[AGREEING]);
    terms[AGREEING] = terms[TERMS - 1];
    of_warps[thread / 32][thread % 32] = sum_of_lanes<16>(terms);
    __syncthreads();
    if (thread < FLOATS) {
        double sum = 0.0, agreeing = 0.0;
        for (int w = 0; w < WARPS; w++) {
            const float of_warp = of_warps[w][thread], first = thread == READ ? floorf(of_warp / BOTH) : of_warp;
            sum += first;
            agreeing += of_warp - BOTH * first;
        }
        of_cell[thread == AGREEING ? TERMS - 1 : thread] = sum;
        if (thread == READ) of_cell[AGREEING] = agreeing;
    }
    __syncthreads();
    if (thread >= NORMAL_TERMS) return;
    const double* b = of_cell + PULL;
    double value;
    if (thread < MATRIX_TERMS) value = of_cell[thread];
    else if (thread < MATRIX_TERMS + 6) value = b[thread - MATRIX_TERMS];
    else if (thread < COMMON) value = of_cell[thread - 6];
    else if (thread == COMMON) {
        const double *sums = of_cell + MATRIX_TERMS, read = sums[2];
        value = common_pixels(sums[1] + read - sums[3], read);
    } else if (thread >= GRAYS) value = of_cell[MATRIX_TERMS + COUNTS + thread - GRAYS];
    else {
        int row = 0, at = thread - (COMMON + 1);
        for (; at >= 6 - row; row++) at -= 6 - row;
        value = b[row] * b[row + at];
    }
    stored[thread] = value;
}

// Store a cell's sums. The last block to arrive adds all cells in order to `total` and returns true. arrived: 0 before
// and after. All threads must call this.
inline bool add_cells(const AlignLevel& L, const AlignOptions& o, const AlignReadouts* times, int apart, const double* T, int cell,
                      double* of_cells, unsigned* arrived, double* total) {
    constexpr int GROUPS = THREADS / NORMAL_TERMS;
    __shared__ bool last;
    __shared__ double of_groups[GROUPS * NORMAL_TERMS];
    const int thread = int(threadIdx.x), cells = cells_of(L);
    store_cell(L, o, times, apart, T, cell, of_cells + size_t(cell) * NORMAL_TERMS);
    __threadfence();                       // make this thread's data visible before the block is counted
    __syncthreads();
    if (thread == 0) last = atomicAdd(arrived, 1u) == unsigned(cells) - 1u;
    __syncthreads();
    if (!last) return false;
    __threadfence();
    if (thread < GROUPS * NORMAL_TERMS) {
        double sum = 0.0;
        for (int k = thread / NORMAL_TERMS; k < cells; k += GROUPS) sum += of_cells[size_t(k) * NORMAL_TERMS + thread % NORMAL_TERMS];
        of_groups[thread] = sum;
    }
    __syncthreads();
    if (thread < NORMAL_TERMS) {
        double sum = 0.0;
        for (int g = 0; g < GROUPS; g++) sum += of_groups[g * NORMAL_TERMS + thread];
        total[thread] = sum;
    }
    if (thread == 0) *arrived = 0;
    __syncthreads();
    return true;
}

constexpr int MOTIONS = 13;                // maximum of one launch: one motion, and six steps in both directions
struct Motions { double T[MOTIONS][12]; };

// Linearise a level at several motions, with one block per cell and motion; timed: whether `readouts` are known: found [motions, NORMAL_TERMS], of_cells
// [motions, cells, NORMAL_TERMS], arrived [motions]. From motion number `whole` on, by fewer rows.
KERNEL normal_equations(AlignPlanes planes, AlignPinhole pinhole, AlignOptions options, AlignReadouts readouts, int timed,
                        Motions motions, int whole, double* of_cells, unsigned* arrived, double* found) {
    __shared__ double total[NORMAL_TERMS];
    const AlignLevel level = {planes, pinhole};
    const int cells = cells_of(level), motion = int(blockIdx.x) / cells;
    double* stored = of_cells + size_t(motion) * cells * NORMAL_TERMS;
    if (add_cells(level, options, timed ? &readouts : nullptr, motion < whole ? 1 : rows_apart(level.height), motions.T[motion], int(blockIdx.x) % cells, stored, arrived + motion, total) && threadIdx.x < NORMAL_TERMS)
        found[motion * NORMAL_TERMS + int(threadIdx.x)] = total[threadIdx.x];
}

// ---- the loop: launched once per possible step; steps of a finished level do nothing -------------------------------

struct AlignState {                        // of one alignment, in device memory; the host reads it at the end (plugins/cuda/images.py)
    AlignLoop loop;
    Descent descent;
    double readings;                       // number of reference pixels with depth
};
struct Guess { double T[12]; };

// reference [2]: its mean depth in metres, and the number of pixels with depth.
KERNEL begin_alignment(AlignState* state, AlignLoop loop, Guess guess, int levels, const double* reference) {
    if (threadIdx.x) return;
    loop.depth_m = reference[0];
    *state = {loop, begin_descent(guess.T, levels), reference[1]};
}

// Take a step on a level, unless the level is finished. of_cells [cells, NORMAL_TERMS], arrived [1].
KERNEL take_align_step(AlignPlanes planes, AlignPinhole pinhole, AlignOptions options, AlignReadouts readouts, int timed,
                       int number, AlignState* state, double* of_cells, unsigned* arrived) {
    __shared__ double total[NORMAL_TERMS];
    if (state->descent.level != number) return;
    options.gain = float(state->descent.gain);
    if (add_cells({planes, pinhole}, options, timed ? &readouts : nullptr, 1, state->descent.T, int(blockIdx.x), of_cells, arrived, total) && threadIdx.x == 0)
        take_step(state->descent, state->loop, total);
}

}  // namespace sigmasplat
