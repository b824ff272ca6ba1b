// View-dependent colours on the CPU: the colours that a camera sees, their gradients, and Adam's step of the harmonics.
// Lanes are splats. fit/mapping_step.py is the definition.

constexpr int HARMONICS = 45;              // columns of the attribute `harmonics`
constexpr int columns_of(int degree) { return 3 * ((degree + 1) * (degree + 1) - 1); }
template <class F> SIGMA_INLINE void with_degree(int degree, F f) {
    switch (degree) {
        case 1: f(std_int<1>{}); break;
        case 2: f(std_int<2>{}); break;
        default: f(std_int<3>{});
    }
}

// Load the harmonics of splats i … i+W−1 to the cache, if the array has them and needed(splat).
template <class Needed> SIGMA_INLINE void prefetch_harmonics(const float* rows, int degree, int64_t i, int64_t n, Needed needed) {
    for (int64_t l = i; l < i + W && l < n; l++)
        if (needed(l))
            for (int q = 0; q < columns_of(degree); q += 16) __builtin_prefetch(rows + l * HARMONICS + q);
}

struct Sight { vf unit[3], inverse_length; };         // the direction from the camera to each splat

SIGMA_INLINE Sight sight_of(const View<float>& view, const vf* mean) {
    vf d[3], square = splat(0.f);
    for (int k = 0; k < 3; k++) {                     // the camera is at −Rᵀ t
        d[k] = mean[k] + (view.R[k] * view.t[0] + view.R[3 + k] * view.t[1] + view.R[6 + k] * view.t[2]);
        square = fma(d[k], d[k], square);
    }
    Sight s;
    s.inverse_length = 1.f / max(sqrt(square), splat(1e-12f));
    for (int k = 0; k < 3; k++) s.unit[k] = d[k] * s.inverse_length;
    return s;
}

// Add the view-dependent part to the colours of splats i … i+W−1; only lanes in `seen` are valid. Their harmonics are
// stored to `lanes` [columns_of(degree)].
template <int DEGREE>
static __attribute__((noinline)) void show_degree(const View<float>& view, const float* harmonics, int64_t i, unsigned seen, const vf* mean,
                                                  vf* color, float (*lanes)[W]) {
    const float *rows[W], *any_row = harmonics + (i + __builtin_ctz(seen)) * HARMONICS;
    for (int l = 0; l < W; l++) rows[l] = (seen >> l) & 1 ? harmonics + (i + l) * HARMONICS : any_row;
    turn_rows<columns_of(DEGREE)>(rows, lanes);
    const Sight s = sight_of(view, mean);
    each_harmonic(s.unit[0], s.unit[1], s.unit[2], DEGREE, [&](int k, vf value) __attribute__((always_inline)) {
        for (int c = 0; c < 3; c++) color[c] = fma(value, load(lanes[3 * k + c]), color[c]);
    });
}
static void show_colors(const View<float>& view, const ViewColors& colors, int64_t i, unsigned seen, const vf* mean, vf* color,
                        float (*lanes)[W]) {
    with_degree(colors.degree, [&](auto d) { show_degree<decltype(d)::value>(view, colors.harmonics, i, seen, mean, color, lanes); });
}

// Step the first COLUMNS harmonics of one splat. The last vector overlaps the one before it, so both are computed from
// the old values.
template <int COLUMNS>
SIGMA_INLINE void adam_harmonics(const AdamStep& a, const Absence& away, const float* g, vf rate, float* p, float* m1, float* m2) {
    constexpr int VECTOR = COLUMNS < W ? COLUMNS : W, LAST = COLUMNS - VECTOR;
    alignas(64) float t[4][W];
    const float* from[4] = {p + LAST, m1 + LAST, m2 + LAST, g + LAST};
    for (int k = 0; k < 4; k++) store(t[k], load_first<VECTOR>(from[k]));
    adam_vector(a, away, load(t[3]), rate, t[0], t[1], t[2], true);
    for (int q = 0; q < LAST; q += W) adam_vector(a, away, load(g + q), rate, p + q, m1 + q, m2 + q, true);
    float* to[3] = {p + LAST, m1 + LAST, m2 + LAST};
    for (int k = 0; k < 3; k++) store_first<VECTOR>(to[k], load(t[k]));
}

// Propagate the gradient of W view-dependent colours (rows 11–13 of `gradient`) to their harmonics, which are stepped,
// and by the viewing direction to the means (added to rows 0–2; returned in `on_mean`). `lanes`: from `show_colors`.
template <int DEGREE>
static __attribute__((noinline)) void step_degree(const View<float>& view, const HarmonicsStep& h, const AdamStep& adam, int64_t i,
                                                  unsigned seen, const vf* mean, float (*gradient)[W], float (*lanes)[W], vf* on_mean) {
    constexpr int COLUMNS = columns_of(DEGREE);
    const Sight s = sight_of(view, mean);
    const vf zero = splat(0.f), one = splat(1.f), shown[3] = {load(gradient[11]), load(gradient[12]), load(gradient[13])};
    const Dual<vf> x = {s.unit[0], {one, zero, zero}}, y = {s.unit[1], {zero, one, zero}}, z = {s.unit[2], {zero, zero, one}};
    vf on_unit[3] = {zero, zero, zero};
    each_harmonic(x, y, z, DEGREE, [&](int k, Dual<vf> value) __attribute__((always_inline)) {
        vf on_value = zero;
        for (int c = 0; c < 3; c++) {
            on_value = fma(load(lanes[3 * k + c]), shown[c], on_value);
            store(lanes[3 * k + c], value.value * shown[c]);
        }
        for (int d = 0; d < 3; d++) on_unit[d] = fma(on_value, value.by[d], on_unit[d]);
    });
    const vf along = dot3(s.unit, on_unit);
    for (int d = 0; d < 3; d++) {
        on_mean[d] = only(mask_of_bits(seen), (on_unit[d] - along * s.unit[d]) * s.inverse_length);
        store(gradient[d], load(gradient[d]) + on_mean[d]);
    }
    alignas(64) float g[COLUMNS * W + W];
    store_rows<COLUMNS>(g, 0, W, lanes);
    int* last = h.state.last_step + i;
    Absence away(adam, last[__builtin_ctz(seen)], true);
    int before = last[__builtin_ctz(seen)];
    for (; seen; seen &= seen - 1) {
        const int l = __builtin_ctz(seen);
        const size_t row = size_t(i + l) * HARMONICS;
        if (last[l] != before) away = Absence(adam, before = last[l], true);
        adam_harmonics<COLUMNS>(adam, away, g + l * COLUMNS, splat(h.rate), h.params + row, h.state.moment1 + row, h.state.moment2 + row);
        last[l] = adam.step;
    }
}
static void step_harmonics(const View<float>& view, const HarmonicsStep& h, const AdamStep& adam, int64_t i, unsigned seen, const vf* mean,
                           float (*gradient)[W], float (*lanes)[W], vf* on_mean) {
    with_degree(h.degree, [&](auto d) { step_degree<decltype(d)::value>(view, h, adam, i, seen, mean, gradient, lanes, on_mean); });
}
