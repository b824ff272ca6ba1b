// Values of pixels summed over each splat: Σ_p w_ip g_p, with the weights w of the last forward pass. It is the gradient
// of the features alone, without the path through the alphas.

constexpr int GATHERED = 16;                          // most planes of a call, and floats of a record

// Near to far: store the weight of each splat that reaches a live pixel. Returns the number of these splats.
template <int ROW_FLOATS>
SIGMA_INLINE int walk_weights(const float* rows, const int* list, int count, vf x, vf y, float log_alpha_min, vf stop, Walk& walk) {
    Pixels *const alphas = walk.alpha.data, *const weights = walk.weight.data;
    int* const entries = walk.entry.data;
    vf T = splat(1.f);
    int n = 0;
    for (int j = 0; j < count && any(ge(T, stop)); j += ALPHA_CHUNK) {
        const int end = count < j + ALPHA_CHUNK ? count : j + ALPHA_CHUNK, begin = n;
        n += live_alphas<ROW_FLOATS>(rows, list, j, end, x, y, ge(T, stop), log_alpha_min, alphas + n, entries + n);
        for (int e = begin; e < n; e++) {
            const vf a = load(alphas[e]);
            store(weights[e], only(ge(T, stop), T * a));
            T = fnma(T, a, T);
        }
    }
    return n;
}

// The values of a block's pixels: one row per pixel, one column per plane.
typedef float PixelValues[W][GATHERED];
SIGMA_INLINE void store_values(const Render& r, const float* planes, int k, size_t at, PixelValues& values) {
    for (int h = 0; h < GATHERED; h += W) {
        vf columns[W];
        for (int c = 0; c < W; c++) columns[c] = h + c < k ? load_block(planes + (h + c) * r.plane() + at, r.padded_width()) : splat(0.f);
        transpose(columns);
        for (int m = 0; m < W; m++) store(values[m] + h, columns[m]);
    }
}

SIGMA_INLINE void add_values(const float* weights, const PixelValues& values, float* record) {
    for (int h = 0; h < GATHERED; h += W) {
        vf acc[2] = {load(record + h), splat(0.f)};
#pragma GCC unroll 16
        for (int m = 0; m < W; m++) acc[m & 1] = fma(splat(weights[m]), load(values[m] + h), acc[m & 1]);
        store(record + h, acc[0] + acc[1]);
    }
}

template <int ROW_FLOATS> static void gather_tiles(Render& r, const float* planes, int k) {
    const float log_alpha_min = __builtin_log2f(r.options.alpha_min);
    const vf stop = splat(r.options.transmittance_stop);
#pragma omp parallel
    {
        Scratch& s = r.scratch[omp_get_thread_num()];
        alignas(64) PixelValues values;
#pragma omp for schedule(dynamic, 1)
        for (int index = 0; index < r.tiles_x * r.tiles_y; index++) {
            const Tile tile = gather_tile<ROW_FLOATS, true, false>(r, s, index);
            memset(s.records.reserve(size_t(tile.count + 1) * GATHERED), 0, size_t(tile.count + 1) * GATHERED * sizeof(float));
            s.walk.reserve(tile.count + 4);
            for (int b = 0; b < BLOCKS; b++) {
                if (!s.counts[b]) continue;
                store_values(r, planes, k, block_at(tile, b, r.padded_width()), values);
                const int n = walk_weights<ROW_FLOATS>(s.rows.data, &s.lists[b * s.list_capacity], s.counts[b], block_x(b), block_y(b),
                                                       log_alpha_min, stop, s.walk);
                for (int e = 0; e < n; e++)
                    add_values(s.walk.weight.data[e], values, &s.records[size_t(s.walk.entry.data[e]) * GATHERED]);
            }
            for (int q = 0; q < tile.count; q++) {
                float* to = &r.partials[size_t(geometry_of<ROW_FLOATS>(s.rows.data, q).tag) * GATHERED];
                for (int c = 0; c < GATHERED; c += W) stream(to + c, load(&s.records[size_t(q) * GATHERED + c]));
            }
        }
        fence();                                      // records may have been written past the caches
    }
}

static void gather_planes(Context* context, const float* planes, int k, float* sums) {
    Render& r = *reinterpret_cast<Render*>(context);
    r.partials.reserve(size_t(r.intersections + 1) * GATHERED);
    with_features(r.k, [&](auto slots) { gather_tiles<row_floats<decltype(slots)::value>>(r, planes, k); });
    const int64_t chunks = (r.n + CHUNK - 1) / CHUNK;
#pragma omp parallel for schedule(static)
    for (int64_t chunk = 0; chunk < chunks; chunk++) {
        size_t slot = size_t(r.chunk_begin[chunk]);
        for (int64_t i = chunk * CHUNK; i < r.n && i < (chunk + 1) * CHUNK; i++) {
            alignas(64) float total[GATHERED] = {};
            for (int q = 0; q < r.tiles_of[i]; q++, slot++)
                for (int c = 0; c < GATHERED; c += W) store(total + c, load(total + c) + load(&r.partials[slot * GATHERED + c]));
            memcpy(sums + i * k, total, size_t(k) * sizeof(float));
        }
    }
}
