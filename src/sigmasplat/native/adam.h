// Adam (Kingma & Ba 2015) on parameter rows [n, 17], a learning rate per column (0 freezes it), for rows in view only.
// A row out of view keeps still; when it is seen again its moments are first decayed by the steps it missed, as dense
// Adam's would have been. What is left out is dense Adam's coasting meanwhile (fit/adam.py bounds it).

struct AdamRates {
    alignas(64) float rate[ROW * W];                  // rates of W rows on end: 17 whole vectors
    float beta1, beta2, epsilon, unbias1, unbias2;
    int step;
    explicit AdamRates(const AdamOptions& o)
        : beta1(o.beta1), beta2(o.beta2), epsilon(o.epsilon), unbias1(1.f / (1.f - __builtin_powf(o.beta1, float(o.step)))),
          unbias2(1.f / (1.f - __builtin_powf(o.beta2, float(o.step)))), step(o.step) {
        for (int i = 0; i < ROW * W; i++) rate[i] = o.rates[i % ROW];
    }
};

// decay1, decay2: β to the power of the steps since the row's last one, this one included.
SIGMA_INLINE void adam_vector(const AdamRates& a, vf g, vf rate, vf decay1, vf decay2, float* p, float* m1, float* m2) {
    const vf m = fma(decay1, load(m1), (1.f - a.beta1) * g);
    const vf v = fma(decay2, load(m2), (1.f - a.beta2) * g * g);
    store(m1, m);
    store(m2, v);
    store(p, fnma(rate, m * a.unbias1 / (sqrt(v * a.unbias2) + a.epsilon), load(p)));
}

// Step the seen among rows i … i+W−1; gradient in lanes.
SIGMA_INLINE void adam_rows(const AdamRates& a, float* params, const AdamState& state, int64_t i, int64_t n, unsigned seen,
                            const float (*gradient)[W]) {
    alignas(64) float g[ROW * W + W];
    store_rows<ROW>(g, 0, W, gradient);
    int* last = state.last_step + i;
    const size_t at = size_t(i) * ROW;
    bool alike = i + W <= n && seen == (W == 32 ? ~0u : (1u << W) - 1u);
    for (int l = 1; alike && l < W; l++) alike = last[l] == last[0];
    if (alike) {
        const float age = float(a.step - last[0]);
        const vf decay1 = splat(__builtin_powf(a.beta1, age)), decay2 = splat(__builtin_powf(a.beta2, age));
        for (int q = 0; q < ROW * W; q += W)
            adam_vector(a, load(g + q), load(a.rate + q), decay1, decay2, params + at + q, state.moment1 + at + q, state.moment2 + at + q);
        for (int l = 0; l < W; l++) last[l] = a.step;
        return;
    }
    for (; seen; seen &= seen - 1) {
        const int l = __builtin_ctz(seen);
        const size_t row = at + size_t(l) * ROW;
        const float age = float(a.step - last[l]);
        const vf decay1 = splat(__builtin_powf(a.beta1, age)), decay2 = splat(__builtin_powf(a.beta2, age));
        alignas(64) float t[3][(ROW + W - 1) / W * W] = {};
        float* from[3] = {params + row, state.moment1 + row, state.moment2 + row};
        for (int k = 0; k < 3; k++) memcpy(t[k], from[k], ROW * sizeof(float));
        for (int q = 0; q < ROW; q += W)
            adam_vector(a, load(g + l * ROW + q), load(a.rate + q), decay1, decay2, t[0] + q, t[1] + q, t[2] + q);
        for (int k = 0; k < 3; k++) memcpy(from[k], t[k], ROW * sizeof(float));
        last[l] = a.step;
    }
}
