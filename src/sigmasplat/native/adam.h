// One Adam step on parameter rows [n, 17], a learning rate per column (0 freezes it). Rows are cut into groups of W, so a
// group is 17 whole vectors and the rates repeat with it.
static void adam(float* params, const float* grad, float* moment1, float* moment2, int64_t n, const float* rates,
                 float beta1, float beta2, float epsilon, int64_t step) {
    const float unbias1 = 1.f / (1.f - __builtin_powf(beta1, float(step))), unbias2 = 1.f / (1.f - __builtin_powf(beta2, float(step)));
    alignas(64) float rate[ROW * W];
    for (int i = 0; i < ROW * W; i++) rate[i] = rates[i % ROW];
    const int64_t total = n * ROW;
#pragma omp parallel for schedule(static)
    for (int64_t group = 0; group < total; group += ROW * W)
        for (int64_t i = group; i < group + ROW * W && i < total; i += W) {
            if (i + W <= total) {
                const vf g = load(grad + i);
                const vf m = fma(splat(beta1), load(moment1 + i), (1.f - beta1) * g);
                const vf v = fma(splat(beta2), load(moment2 + i), (1.f - beta2) * g * g);
                store(moment1 + i, m);
                store(moment2 + i, v);
                store(params + i, fnma(load(rate + (i - group)), m * unbias1 / (sqrt(v * unbias2) + epsilon), load(params + i)));
            } else {
                for (int64_t q = i; q < total; q++) {
                    const float g = grad[q];
                    moment1[q] = beta1 * moment1[q] + (1.f - beta1) * g;
                    moment2[q] = beta2 * moment2[q] + (1.f - beta2) * g * g;
                    params[q] -= rate[q - group] * (moment1[q] * unbias1) / (__builtin_sqrtf(moment2[q] * unbias2) + epsilon);
                }
            }
        }
}
