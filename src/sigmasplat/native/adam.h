// Adam (Kingma & Ba 2015) on parameter rows [n, 17], with a learning rate per column (0 freezes it). Only rows in view
// are stepped. Dense Adam would also move the other rows, because their moments decay slowly. This missed motion is
// added when a row is visible again, or by `adam_settle`. fit/adam.py is the definition.

struct AdamStep {
    float beta1, beta2, epsilon, unbias1, unbias2;
    int step;
    AdamStep(const AdamOptions& o, int number)
        : beta1(o.beta1), beta2(o.beta2), epsilon(o.epsilon), unbias1(1.f / (1.f - __builtin_powf(o.beta1, float(number)))),
          unbias2(1.f / (1.f - __builtin_powf(o.beta2, float(number)))), step(number) {}
};

struct AdamRates : AdamStep {
    alignas(64) float rate[ROW * W];                  // rates of W consecutive rows: 17 whole vectors
    explicit AdamRates(const AdamOptions& o) : AdamStep(o, o.step) {
        for (int i = 0; i < ROW * W; i++) rate[i] = o.rates[i % ROW];
    }
};

// The motion and decay that a row missed between step `last`, when it last moved, and step `to`.
struct Absence {
    float decay1, decay2;                             // decay of both moments up to step `to`
    float coasted, unbias1, unbias2;                  // missed motion in steps like the last: Σ (β1/√β2)^j, j = 1 … to − last (− 1)
    Absence(const AdamStep& a, int last, bool stepped) {
        const int age = a.step - last, missed = stepped ? age - 1 : age;
        decay1 = __builtin_powf(a.beta1, float(age));
        decay2 = __builtin_powf(a.beta2, float(age));
        const float r = a.beta1 / __builtin_sqrtf(a.beta2);
        coasted = missed > 0 && last > 0 ? r * (1.f - __builtin_powf(r, float(missed))) / (1.f - r) : 0.f;
        unbias1 = coasted ? 1.f / (1.f - __builtin_powf(a.beta1, float(last))) : 0.f;
        unbias2 = coasted ? 1.f / (1.f - __builtin_powf(a.beta2, float(last))) : 0.f;
    }
};

SIGMA_INLINE void adam_vector(const AdamStep& a, const Absence& away, vf g, vf rate, float* p, float* m1, float* m2, bool stepped) {
    const vf m0 = load(m1), v0 = load(m2), m = fma(splat(away.decay1), m0, (1.f - a.beta1) * g),
             v = fma(splat(away.decay2), v0, (1.f - a.beta2) * g * g);
    vf value = load(p);
    if (away.coasted) value = fnma(rate * away.coasted, m0 * away.unbias1 / (sqrt(v0 * away.unbias2) + a.epsilon), value);
    if (stepped) value = fnma(rate, m * a.unbias1 / (sqrt(v * a.unbias2) + a.epsilon), value);
    store(m1, m);
    store(m2, v);
    store(p, value);
}

// Step values whose absences differ.
struct Moved { vf value, moment1, moment2; };
SIGMA_INLINE Moved adam_moved(const AdamStep& a, vf decay1, vf decay2, vf coasted, vf unbias1, vf unbias2, vf g, vf rate, vf p, vf m0, vf v0) {
    const vf m = fma(decay1, m0, (1.f - a.beta1) * g), v = fma(decay2, v0, (1.f - a.beta2) * g * g);
    const vf value = fnma(rate * coasted, m0 * unbias1 / (sqrt(v0 * unbias2) + a.epsilon), p);
    return {fnma(rate, m * a.unbias1 / (sqrt(v * a.unbias2) + a.epsilon), value), m, v};
}

SIGMA_INLINE void adam_row(const AdamRates& a, const Absence& away, const float* g, float* p, float* m1, float* m2, bool stepped) {
    alignas(64) float t[3][(ROW + W - 1) / W * W] = {};
    float* from[3] = {p, m1, m2};
    for (int k = 0; k < 3; k++) memcpy(t[k], from[k], ROW * sizeof(float));
    for (int q = 0; q < ROW; q += W)
        adam_vector(a, away, g ? load(g + q) : splat(0.f), load(a.rate + q), t[0] + q, t[1] + q, t[2] + q, stepped);
    for (int k = 0; k < 3; k++) memcpy(from[k], t[k], ROW * sizeof(float));
}

// Step the visible rows (`seen`) among rows i … i+W−1; the gradient is in lanes.
SIGMA_INLINE void adam_rows(const AdamRates& a, float* params, const AdamState& state, int64_t i, int64_t n, unsigned seen,
                            const float (*gradient)[W]) {
    alignas(64) float g[ROW * W + W];
    store_rows<ROW>(g, 0, W, gradient);
    int* last = state.last_step + i;
    const size_t at = size_t(i) * ROW;
    bool alike = i + W <= n && seen == (1u << W) - 1u;
    for (int l = 1; alike && l < W; l++) alike = last[l] == last[0];
    if (alike) {
        const Absence away(a, last[0], true);
        for (int q = 0; q < ROW * W; q += W)
            adam_vector(a, away, load(g + q), load(a.rate + q), params + at + q, state.moment1 + at + q, state.moment2 + at + q, true);
        for (int l = 0; l < W; l++) last[l] = a.step;
        return;
    }
    // Whole vectors of each row, and the last column of all rows together.
    constexpr int LAST = ROW - 1;
    static_assert(LAST % W == 0);
    alignas(64) float tail[4][W] = {}, decay1[W] = {}, decay2[W] = {}, coasted[W] = {}, unbias1[W] = {}, unbias2[W] = {};
    float *const p = params + at, *const m1 = state.moment1 + at, *const m2 = state.moment2 + at;
    int before = last[__builtin_ctz(seen)];
    Absence away(a, before, true);
    for (unsigned left = seen; left; left &= left - 1) {
        const int l = __builtin_ctz(left), row = l * ROW;
        if (last[l] != before) away = Absence(a, before = last[l], true);
        for (int q = 0; q < LAST; q += W) adam_vector(a, away, load(g + row + q), load(a.rate + q), p + row + q, m1 + row + q, m2 + row + q, true);
        tail[0][l] = g[row + LAST]; tail[1][l] = p[row + LAST]; tail[2][l] = m1[row + LAST]; tail[3][l] = m2[row + LAST];
        decay1[l] = away.decay1; decay2[l] = away.decay2;
        coasted[l] = away.coasted; unbias1[l] = away.unbias1; unbias2[l] = away.unbias2;
        last[l] = a.step;
    }
    const Moved moved = adam_moved(a, load(decay1), load(decay2), load(coasted), load(unbias1), load(unbias2), load(tail[0]),
                                   splat(a.rate[LAST]), load(tail[1]), load(tail[2]), load(tail[3]));
    store(tail[1], moved.value); store(tail[2], moved.moment1); store(tail[3], moved.moment2);
    for (unsigned left = seen; left; left &= left - 1) {
        const int l = __builtin_ctz(left), row = l * ROW + LAST;
        p[row] = tail[1][l]; m1[row] = tail[2][l]; m2[row] = tail[3][l];
    }
}

// Apply the missed motion and decay to every row.
static void adam_settle(float* params, int64_t n, AdamState state, AdamOptions options) {
    const AdamRates a(options);
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n; i++) {
        if (state.last_step[i] == a.step) continue;
        const size_t row = size_t(i) * ROW;
        adam_row(a, Absence(a, state.last_step[i], false), nullptr, params + row, state.moment1 + row, state.moment2 + row, false);
        state.last_step[i] = a.step;
    }
}
