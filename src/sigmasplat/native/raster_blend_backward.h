// Stage 3 backwards: gradients on pixels → a record per tile and splat → sums per splat. Derivation: docs/kernels.md.

// The record of a splat's gradient in one tile. First 8 interleaved pairs (even: sums of g·{1, x, y, xx, xy, yy}; odd:
// sums of w·∂L/∂feature), then the remaining w-sums. SLOPES: ∂L/∂depth times x and y. MOMENT: 2·∂L/∂moment, with SLOPES
// times {1, x, y, xx, xy, yy}, and its product with −ref, with SLOPES times {1, x, y}. With SLOPES and without MOMENT, the
// sums are packed if they fit in 16 floats but not in 8 pairs: first the 6 sums of g, then those of w.
template <int K, bool MOMENT, bool SLOPES = false> constexpr int moment_column = K + (SLOPES ? 2 : 0);
template <int K, bool MOMENT, bool SLOPES = false> constexpr int weight_columns =
    moment_column<K, MOMENT, SLOPES> + (!MOMENT ? 0 : SLOPES ? 9 : 2);
template <int K, bool MOMENT, bool SLOPES = false> constexpr bool is_packed =
    SLOPES && !MOMENT && weight_columns<K, MOMENT, SLOPES> > 8 && weight_columns<K, MOMENT, SLOPES> <= 10;
template <int K, bool MOMENT, bool SLOPES = false> constexpr int extra_floats =
    weight_columns<K, MOMENT, SLOPES> <= 8 || is_packed<K, MOMENT, SLOPES> ? 0 : (weight_columns<K, MOMENT, SLOPES> - 8 + W - 1) / W * W;
template <int K, bool MOMENT, bool SLOPES = false> constexpr int record_floats = 16 + extra_floats<K, MOMENT, SLOPES>;
template <bool PACKED = false> constexpr int moment_place(int q) { return PACKED ? q : 2 * q; }   // where a record has g-sum q
template <bool PACKED = false> constexpr int weight_place(int c) { return PACKED ? 6 + c : c < 8 ? 2 * c + 1 : 8 + c; }

#if defined(__AVX512F__)
SIGMA_INLINE void store_pairs(float* out, vf g, vf w) {
    store(out, (vf)_mm512_unpacklo_ps((__m512)g, (__m512)w));
    store(out + W, (vf)_mm512_unpackhi_ps((__m512)g, (__m512)w));
}
#elif defined(__AVX2__)
SIGMA_INLINE void store_pairs(float* out, vf g, vf w) {
    store(out, (vf)_mm256_unpacklo_ps((__m256)g, (__m256)w));
    store(out + W, (vf)_mm256_unpackhi_ps((__m256)g, (__m256)w));
}
#else
SIGMA_INLINE void store_pairs(float* out, vf g, vf w) {
    store(out, __builtin_shufflevector(g, w, 0, 4, 1, 5));
    store(out + W, __builtin_shufflevector(g, w, 2, 6, 3, 7));
}
#endif
constexpr int pixel_of_pair(int m) { return m < W / 2 ? m / 2 * 4 + m % 2 : (m - W / 2) / 2 * 4 + 2 + m % 2; }

typedef long long vpair __attribute__((vector_size(W * 4)));
SIGMA_INLINE vf splat_pair(const float* p) { long long bits; memcpy(&bits, p, 8); return (vf)(bits - vpair{}); }

// ∂L/∂(outputs) at a block's pixels.
template <int K> struct PixelGradients { vf sums[K], alpha, moment, ref; };

template <int K, bool MOMENT> SIGMA_INLINE PixelGradients<K> gradients_at(const Render& r, const OutputGradients& g, size_t at) {
    const size_t plane = r.plane(), stride = r.padded_width();
    PixelGradients<K> on_pixels;
    for (int c = 0; c < K; c++) on_pixels.sums[c] = load_block(g.sums + c * plane + at, stride);
    on_pixels.alpha = g.alpha ? load_block(g.alpha + at, stride) : splat(0.f);
    on_pixels.ref = MOMENT ? load_block(r.reference + at, stride) : splat(0.f);
    on_pixels.moment = MOMENT ? only(gt(on_pixels.ref, splat(0.f)), load_block(g.moment + at, stride)) : splat(0.f);
    return on_pixels;
}

// The factors of each pixel's pair (g, w): one row per pixel, in the order of `store_pairs`, and one column per sum of
// the record.
template <int K, bool MOMENT, bool SLOPES> using Basis = float[W][record_floats<K, MOMENT, SLOPES>];
template <int K, bool MOMENT, bool SLOPES>
SIGMA_INLINE void store_basis(const PixelGradients<K>& on_pixels, vf x, vf y, Basis<K, MOMENT, SLOPES>& basis) {
    constexpr int COLUMNS = record_floats<K, MOMENT, SLOPES>, AT = moment_column<K, MOMENT, SLOPES>;
    constexpr bool PACKED = is_packed<K, MOMENT, SLOPES>;
    vf columns[COLUMNS];
    for (auto& c : columns) c = splat(0.f);
    const vf moments[6] = {splat(1.f), x, y, x * x, x * y, y * y};
    for (int c = 0; c < 6; c++) columns[moment_place<PACKED>(c)] = moments[c];
    const auto weighed = [&](int c, vf v) { columns[weight_place<PACKED>(c)] = v; };
    for (int c = 0; c < K; c++) weighed(c, on_pixels.sums[c]);
    if constexpr (SLOPES) {
        weighed(K, on_pixels.sums[3] * x);
        weighed(K + 1, on_pixels.sums[3] * y);
    }
    if constexpr (MOMENT) {
        const vf twice = 2.f * on_pixels.moment, by_ref = -2.f * on_pixels.moment * on_pixels.ref;
        weighed(AT, twice);
        weighed(AT + (SLOPES ? 6 : 1), by_ref);
        if constexpr (SLOPES) {
            for (int q = 1; q < 6; q++) weighed(AT + q, twice * moments[q]);
            for (int q = 1; q < 3; q++) weighed(AT + 6 + q, by_ref * moments[q]);
        }
    }
    for (int h = 0; h < COLUMNS; h += W) {
        transpose(columns + h);
        for (int m = 0; m < W; m++) store(basis[m] + h, columns[h + (PACKED ? m : pixel_of_pair(m))]);
    }
}

// Near to far: store alpha, weight w and gain G = ∂L/∂w of each splat that reaches a live pixel. Returns their number.
template <int ROW_FLOATS, int K, bool MOMENT, bool SLOPES>
SIGMA_INLINE int walk_out(const float* rows, const int* list, int count, vf x, vf y, const PixelGradients<K>& on_pixels,
                          float log_alpha_min, vf stop, Walk& walk) {
    Pixels *const alphas = walk.alpha.data, *const weights = walk.weight.data, *const gains = walk.gain.data;
    int* const entries = walk.entry.data;
    vf T = splat(1.f);
    int n = 0;
    for (int j = 0; j < count && any(ge(T, stop)); j += ALPHA_CHUNK) {
        const int end = count < j + ALPHA_CHUNK ? count : j + ALPHA_CHUNK, begin = n;
        n += live_alphas<ROW_FLOATS>(rows, list, j, end, x, y, ge(T, stop), log_alpha_min, alphas + n, entries + n);
        for (int e = begin; e < n; e++) {
            const float* row = rows + size_t(entries[e]) * ROW_FLOATS;
            const vf a = load(alphas[e]);
            const Mask on = ge(T, stop);
            const vf w = only(on, T * a);
            vf gain = on_pixels.alpha;
            if constexpr (SLOPES) {
                vf depth = splat(reinterpret_cast<const Geometry*>(row)->z);
                depth = fma(splat(row[GEOMETRY + SLOPE_V]), y, fma(splat(row[GEOMETRY + SLOPE_U]), x, depth));
                for (int c = 0; c < K; c++)
                    if (c != 3) gain = fma(on_pixels.sums[c], splat(row[GEOMETRY + c]), gain);
                gain = fma(on_pixels.sums[3], depth, gain);
                if (MOMENT) {
                    const vf d = depth - on_pixels.ref;
                    gain = fma(on_pixels.moment * d, d, gain);
                }
            } else {
                for (int c = 0; c < K; c++) gain = fma(on_pixels.sums[c], splat(row[GEOMETRY + c]), gain);
                if (MOMENT) {
                    const vf d = reinterpret_cast<const Geometry*>(row)->z - on_pixels.ref;
                    gain = fma(on_pixels.moment * d, d, gain);
                }
            }
            store(weights[e], w);
            store(gains[e], only(on, gain));
            T = fnma(T, a, T);
        }
    }
    return n;
}

// Add one splat's sums over a block's pixels to its record: pairs times basis.
template <int K, bool MOMENT, bool SLOPES>
SIGMA_INLINE void add_to_record(const float* pairs, const Basis<K, MOMENT, SLOPES>& basis, float* record) {
    constexpr int EXTRA = extra_floats<K, MOMENT, SLOPES>;
    vf acc[16 / W][2], rest[EXTRA ? EXTRA / W : 1];       // two chains of additions, so that each waits half as long
    for (int h = 0; h < 16 / W; h++) { acc[h][0] = load(record + h * W); acc[h][1] = splat(0.f); }
    if constexpr (is_packed<K, MOMENT, SLOPES>) {         // `pairs` has all g, then all w
#pragma GCC unroll 16
        for (int m = 0; m < W; m++) {
            const vf gain = splat(pairs[m]), weight = splat(pairs[W + m]);
            for (int h = 0; h < 16 / W; h++)
                acc[h][m & 1] = fma(select(first_lanes(6 - h * W), gain, weight), load(basis[m] + h * W), acc[h][m & 1]);
        }
        for (int h = 0; h < 16 / W; h++) store(record + h * W, acc[h][0] + acc[h][1]);
        return;
    }
    for (int h = 0; h < EXTRA / W; h++) rest[h] = load(record + 16 + h * W);
#pragma GCC unroll 16
    for (int m = 0; m < W; m++) {
        const vf pair = splat_pair(pairs + 2 * m);
        for (int h = 0; h < 16 / W; h++) acc[h][m & 1] = fma(pair, load(basis[m] + h * W), acc[h][m & 1]);
        if (EXTRA) {
            const vf weight = splat(pairs[2 * m + 1]);
            for (int h = 0; h < EXTRA / W; h++) rest[h] = fma(weight, load(basis[m] + 16 + h * W), rest[h]);
        }
    }
    for (int h = 0; h < 16 / W; h++) store(record + h * W, acc[h][0] + acc[h][1]);
    for (int h = 0; h < EXTRA / W; h++) store(record + 16 + h * W, rest[h]);
}

// Far to near. C is the gain of one unit of light from behind a splat: ∂L/∂α = T·(G − C), then C ← (1 − α)·C + α·G. C
// is not computed as a difference of sums over all splats: where T is small, opaque splats in front would leave only
// rounding errors in it.
template <int K, bool MOMENT, bool SLOPES>
SIGMA_INLINE void walk_back(int n, const Basis<K, MOMENT, SLOPES>& basis, Walk& walk, float* records) {
    const Pixels *const alphas = walk.alpha.data, *const weights = walk.weight.data, *const gains = walk.gain.data;
    const int* const entries = walk.entry.data;
    const vf one = splat(1.f), top = splat(ALPHA_MAX);
    vf behind = splat(0.f);
    for (int end = n; end > 0; end -= ALPHA_CHUNK) {
        const int begin = end > ALPHA_CHUNK ? end - ALPHA_CHUNK : 0;
        for (int e = end - 1; e >= begin; e--) {
            const vf a = load(alphas[e]), w = load(weights[e]), gain = load(gains[e]);
            const vf on_power = only(gt(top, a), w * (gain - behind));       // α·∂L/∂α = ∂L/∂power
            if constexpr (is_packed<K, MOMENT, SLOPES>) {
                store(walk.pairs[e - begin], on_power);
                store(walk.pairs[e - begin] + W, w);
            } else {
                store_pairs(walk.pairs[e - begin], on_power, w);
            }
            behind = fma(one - a, behind, a * gain);
        }
        for (int e = begin; e < end; e++)
            add_to_record<K, MOMENT, SLOPES>(walk.pairs[e - begin], basis, records + size_t(entries[e]) * record_floats<K, MOMENT, SLOPES>);
    }
}

// Process every tile's pixels again and pass its records to `finish(scratch, tile)`. The first K of a row's ROW_K
// features have gradients; the others are skipped.
template <int ROW_K, int K, bool MOMENT, bool SLOPES, class Finish>
static void blend_tiles_backward(Render& r, OutputGradients g, Finish finish) {
    constexpr int RECORD = record_floats<K, MOMENT, SLOPES>;
    const float log_alpha_min = __builtin_log2f(r.options.alpha_min);
    const vf stop = splat(r.options.transmittance_stop);
#pragma omp parallel
    {
        Scratch& s = r.scratch[omp_get_thread_num()];
        alignas(64) Basis<K, MOMENT, SLOPES> basis;
#pragma omp for schedule(dynamic, 1)
        for (int index = 0; index < r.tiles_x * r.tiles_y; index++) {
            const Tile tile = gather_tile<row_floats<ROW_K>, true, SLOPES>(r, s, index);
            memset(s.records.reserve(size_t(tile.count + W) * RECORD), 0, size_t(tile.count + W) * RECORD * sizeof(float));
            s.walk.reserve(tile.count + 4);
            for (int b = 0; b < BLOCKS; b++) {
                if (!s.counts[b]) continue;
                const vf x = block_x(b), y = block_y(b);
                const PixelGradients<K> on_pixels = gradients_at<K, MOMENT>(r, g, block_at(tile, b, r.padded_width()));
                store_basis<K, MOMENT, SLOPES>(on_pixels, x, y, basis);
                const int n = walk_out<row_floats<ROW_K>, K, MOMENT, SLOPES>(
                    s.rows.data, &s.lists[b * s.list_capacity], s.counts[b], x, y, on_pixels, log_alpha_min, stop, s.walk);
                walk_back<K, MOMENT, SLOPES>(n, basis, s.walk, s.records.data);
            }
            finish(s, tile);
        }
        fence();                                      // records may have been written past the caches
    }
}

// Move the centre of a record's moments from the tile's centre to the splat's mean, at (u, v) relative to it.
template <class T> SIGMA_INLINE void shift_moments(T m0, T& mx, T& my, T& mxx, T& mxy, T& myy, T u, T v) {
    mxx += u * (u * m0 - 2.f * mx);
    mxy += u * (v * m0 - my) - v * mx;
    myy += v * (v * m0 - 2.f * my);
    mx -= u * m0;
    my -= v * m0;
}

// The same for the w-sums of depth, `at(c)` is the place of sum c.
template <int K, bool MOMENT, class T, class At> SIGMA_INLINE void shift_depth_sums(At at, T u, T v) {
    const T on_depth = at(3);
    at(K) -= u * on_depth;
    at(K + 1) -= v * on_depth;
    if constexpr (MOMENT) {
        constexpr int M = moment_column<K, true, true>;
        shift_moments(T(at(M)), at(M + 1), at(M + 2), at(M + 3), at(M + 4), at(M + 5), u, v);
        const T by_ref = at(M + 6);
        at(M + 7) -= u * by_ref;
        at(M + 8) -= v * by_ref;
    }
}

// Copy a tile's records to each splat's own slots; the moments are now about the splat's mean.
template <int K, bool MOMENT, bool SLOPES> static void flush_records(Render& r, Scratch& s, const Tile& tile) {
    constexpr int RECORD = record_floats<K, MOMENT, SLOPES>;
    constexpr bool PACKED = is_packed<K, MOMENT, SLOPES>;
    constexpr int ONE = moment_place<PACKED>(1);
    for (int k = 0; k < tile.count; k++) {
        float* m = &s.records[size_t(k) * RECORD];
        shift_moments(m[0], m[ONE], m[2 * ONE], m[3 * ONE], m[4 * ONE], m[5 * ONE], s.centers[k].u, s.centers[k].v);
        if constexpr (SLOPES)
            shift_depth_sums<K, MOMENT>([&](int c) -> float& { return m[weight_place<PACKED>(c)]; }, s.centers[k].u, s.centers[k].v);
    }
    for (int k = 0; k < tile.count; k++) {
        const Geometry& g = *reinterpret_cast<const Geometry*>(&s.rows[size_t(k) * r.row]);
        float* to = &r.partials[size_t(g.tag) * RECORD];
        for (int c = 0; c < RECORD; c += W) stream(to + c, load(&s.records[size_t(k) * RECORD + c]));
    }
}

// Sum the per-tile records of W splats in slot order and transpose them to lanes, sums[column][lane]; advances `slot`.
template <int RECORD> SIGMA_INLINE void reduce_records(const Render& r, int64_t i, int& slot, float (*sums)[W]) {
    constexpr int PARTS = RECORD / W;
    vf turn[PARTS][W];
    for (int l = 0; l < W; l++) {
        const int count = i + l < r.n ? r.tiles_of[i + l] : 0;
        for (int h = 0; h < PARTS; h++) turn[h][l] = splat(0.f);
        for (int q = 0; q < count; q++, slot++)
            for (int h = 0; h < PARTS; h++) turn[h][l] += load(&r.partials[size_t(slot) * RECORD + h * W]);
    }
    for (int h = 0; h < PARTS; h++) {
        transpose(turn[h]);
        for (int c = 0; c < W; c++) store(sums[h * W + c], turn[h][c]);
    }
}

// ∂L/∂feature c of W splats, from their summed records.
template <bool PACKED = false> SIGMA_INLINE vf weight_sum(const float (*sums)[W], int c) { return load(sums[weight_place<PACKED>(c)]); }

// ∂L/∂(mean, conic) of W splats. power = −½(p² + q²), so every derivative is a moment of g about the splat's mean.
struct Moments { vf m[6]; };                           // Σ g·{1, x, y, xx, xy, yy} about the splat's mean
template <bool PACKED = false> SIGMA_INLINE Moments moments_of(const float (*sums)[W]) {
    Moments a;
    for (int q = 0; q < 6; q++) a.m[q] = load(sums[moment_place<PACKED>(q)]);
    return a;
}
SIGMA_INLINE FootprintGradient<vf> footprint_gradient(const Moments& moments, vf l1, vf l2, vf l3) {
    const vf *m = moments.m, mx = m[1], my = m[2], mxx = m[3], mxy = m[4], myy = m[5];
    FootprintGradient<vf> g;
    const vf p = l1 * mx + l2 * my;
    g.u = l1 * p;
    g.v = l2 * p + l3 * l3 * my;
    g.l1 = -(l1 * mxx + l2 * mxy);
    g.l2 = -(l1 * mxy + l2 * myy);
    g.l3 = -l3 * myy;
    g.z = splat(0.f);
    return g;
}

// Add ∂L/∂(depth at the pixels) of W splats to the gradient of their footprints, from w-sums about their means.
template <int K, bool MOMENT>
SIGMA_INLINE void add_depth_gradient(const float (*sums)[W], const Footprint<vf>& p, FootprintGradient<vf>& g) {
    constexpr bool PACKED = is_packed<K, MOMENT, true>;
    vf on_depth = weight_sum<PACKED>(sums, 3), on_u = weight_sum<PACKED>(sums, K), on_v = weight_sum<PACKED>(sums, K + 1);
    if constexpr (MOMENT) {                           // 2·w·∂L/∂U·(z + slopes·(x, y) − ref), times 1, x and y
        constexpr int M = moment_column<K, true, true>;
        vf m[9];
        for (int q = 0; q < 9; q++) m[q] = weight_sum(sums, M + q);
        on_depth += fma(p.z, m[0], fma(p.slope_u, m[1], fma(p.slope_v, m[2], m[6])));
        on_u += fma(p.z, m[1], fma(p.slope_u, m[3], fma(p.slope_v, m[4], m[7])));
        on_v += fma(p.z, m[2], fma(p.slope_u, m[4], fma(p.slope_v, m[5], m[8])));
    }
    g.z = on_depth;
    g.slope_u = on_u;
    g.slope_v = on_v;
    g.u = fnma(p.slope_u, on_depth, g.u);
    g.v = fnma(p.slope_v, on_depth, g.v);
}
