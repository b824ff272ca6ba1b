// Stage 3: tiles → pixels. A tile is divided into blocks of W pixels, one pixel per lane. Each block processes its own
// list of splats, near to far. Alphas are computed first, one chunk at a time, so that the dependency chain of the
// transmittance is one multiply-add per splat.

constexpr int AHEAD = 24;                             // number of splats to prefetch
struct Tile { int index, x, y, count; };              // x, y: pixel of its corner

SIGMA_INLINE BlockMask block_mask(Box b, int tile_bx, int tile_by) {
    const int c0 = b.x0 > tile_bx ? b.x0 - tile_bx : 0, c1 = (b.x1 < tile_bx + BLOCKS_X - 1 ? b.x1 - tile_bx : BLOCKS_X - 1);
    const int r0 = b.y0 > tile_by ? b.y0 - tile_by : 0, r1 = (b.y1 < tile_by + BLOCKS_Y - 1 ? b.y1 - tile_by : BLOCKS_Y - 1);
    const uint64_t columns = ((1ull << (c1 - c0 + 1)) - 1) << c0;
    uint64_t every_row = 0;                           // bit 0 of each row, a constant
    for (int y = 0; y < BLOCKS_Y; y++) every_row |= 1ull << (y * BLOCKS_X);
    const int rows = (r1 - r0 + 1) * BLOCKS_X;
    const uint64_t span = (rows == 64 ? ~0ull : (1ull << rows) - 1) << (r0 * BLOCKS_X);
    return BlockMask((columns * every_row) & span);
}

// For each block, list in order which of a tile's n splats reach it. Each list ends with four entries that are never
// alive.
SIGMA_INLINE void list_blocks(Scratch& s, int n) {
    s.list_capacity = size_t(n) + W + 4;
    s.lists.reserve(s.list_capacity * BLOCKS);
#if defined(__AVX512F__)
    constexpr int HALVES = sizeof(BlockMask) / sizeof(uint32_t);
    uint32_t halves[HALVES][W];
    for (int b = 0; b < BLOCKS; b++) s.counts[b] = 0;
    for (int k = 0; k < n; k += W) {
        for (int l = 0; l < W; l++)
            for (int h = 0; h < HALVES; h++) halves[h][l] = uint32_t(uint64_t(s.masks[k + l]) >> (32 * h));
        const __m512i low = _mm512_loadu_si512(halves[0]), high = _mm512_loadu_si512(halves[HALVES - 1]);
        const __m512i entry = _mm512_add_epi32(_mm512_set1_epi32(k), (__m512i)to_int(lane_index()));
        for (int b = 0; b < BLOCKS; b++) {
            const __mmask16 on = _mm512_test_epi32_mask(b < 32 ? low : high, _mm512_set1_epi32(int(1u << (b & 31))));
            _mm512_storeu_si512(&s.lists[b * s.list_capacity + s.counts[b]], _mm512_maskz_compress_epi32(on, entry));
            s.counts[b] += __builtin_popcount(on);
        }
    }
#else
    memset(s.counts, 0, sizeof s.counts);
    for (int k = 0; k < n; k++)
        for (BlockMask m = s.masks[k]; m; m &= m - 1) {
            const int b = __builtin_ctzll(m);
            s.lists[b * s.list_capacity + s.counts[b]++] = k;
        }
#endif
    for (int b = 0; b < BLOCKS; b++)
        for (int q = 0; q < 4; q++) s.lists[b * s.list_capacity + s.counts[b] + q] = n;
}

// Copy a tile's splats, near to far, with coordinates relative to the tile's centre, and list them per block.
// SLOPES: the depth of a row is moved to the tile's centre.
template <int ROW_FLOATS, bool BACKWARD, bool SLOPES> static Tile gather_tile(const Render& r, Scratch& s, int index) {
    const int begin = r.tile_begin[index], n = r.tile_begin[index + 1] - begin;
    const int tx = index % r.tiles_x, ty = index / r.tiles_x;
    const Tile tile{index, tx * TILE_WIDTH, ty * TILE_HEIGHT, n};
    const float cx = tile.x + (TILE_WIDTH - 1) * 0.5f, cy = tile.y + (TILE_HEIGHT - 1) * 0.5f;
    constexpr size_t row = ROW_FLOATS, row_bytes = row * sizeof(float);
    s.rows.reserve(size_t(n + 1) * row);
    s.masks.reserve(n + W);
    if (BACKWARD) memset(static_cast<void*>(s.centers.reserve(n + W) + n), 0, W * sizeof(Center));
    const uint64_t* items = r.items.data + begin;
    for (int k = 0; k < n; k++) {
        if (k + AHEAD < n) {
            const uint32_t ahead = uint32_t(items[k + AHEAD]);
            __builtin_prefetch(&r.rows[size_t(ahead) * row]);
            __builtin_prefetch(&r.rows[size_t(ahead) * row + row - 1]);
            __builtin_prefetch(&r.boxes[ahead]);
        }
        const uint32_t i = uint32_t(items[k]);
        const Box box = r.boxes[i];
        float* to = &s.rows[k * row];
        constexpr size_t VECTORS = row / W * W;       // GCC copies a small constant size in pieces of 8 bytes
        for (size_t q = 0; q < VECTORS; q += W) store(to + q, load(&r.rows[i * row + q]));
        if constexpr (VECTORS < row) memcpy(to + VECTORS, &r.rows[i * row + VECTORS], row_bytes - VECTORS * sizeof(float));
        Geometry& g = *reinterpret_cast<Geometry*>(to);
        const float u = g.u - cx, v = g.v - cy;
        g.u = -(g.l1 * u + g.l2 * v);                 // p = l1·x + l2·y + g.u, q = l3·y + g.v with x, y from the tile's centre
        g.v = -g.l3 * v;
        if constexpr (SLOPES) g.z -= to[GEOMETRY + SLOPE_U] * u + to[GEOMETRY + SLOPE_V] * v;
        if (BACKWARD) {
            const int columns = box.x1 / BLOCKS_X - box.x0 / BLOCKS_X + 1;
            g.tag += r.chunk_begin[i / CHUNK] + (ty - box.y0 / BLOCKS_Y) * columns + (tx - box.x0 / BLOCKS_X);
            s.centers[k] = {u, v};
        } else {
            g.tag = int(i);
        }
        s.masks[k] = block_mask(box, tx * BLOCKS_X, ty * BLOCKS_Y);
    }
    memset(&s.masks[n], 0, W * sizeof(BlockMask));
    memset(&s.rows[n * row], 0, row_bytes);           // the entry at the end of each list: never alive
    reinterpret_cast<Geometry*>(&s.rows[n * row])->log_opacity = -1e30f;
    list_blocks(s, n);
    return tile;
}

SIGMA_INLINE vf block_x(int b) {
    vf x;
    for (int l = 0; l < W; l++) x[l] = float(l % BLOCK_WIDTH) + float(b % BLOCKS_X * BLOCK_WIDTH) - (TILE_WIDTH - 1) * 0.5f;
    return x;
}
SIGMA_INLINE vf block_y(int b) {
    vf y;
    for (int l = 0; l < W; l++) y[l] = float(l / BLOCK_WIDTH) + float(b / BLOCKS_X * BLOCK_HEIGHT) - (TILE_HEIGHT - 1) * 0.5f;
    return y;
}

// Return the position of a tile's block b in the planes.
SIGMA_INLINE size_t block_at(const Tile& tile, int b, size_t stride) {
    return (tile.y + size_t(b / BLOCKS_X) * BLOCK_HEIGHT) * stride + tile.x + b % BLOCKS_X * BLOCK_WIDTH;
}

template <int ROW_FLOATS> SIGMA_INLINE const Geometry& geometry_of(const float* rows, int entry) {
    return *reinterpret_cast<const Geometry*>(rows + size_t(entry) * ROW_FLOATS);
}

// Compute alphas of up to ALPHA_CHUNK entries of a block's list. Entries that reach no live pixel are dropped, without
// a branch.
template <int ROW_FLOATS> SIGMA_INLINE int live_alphas(const float* rows, const int* list, int begin, int end, vf x, vf y, Mask alive,
                             float log_alpha_min, Pixels* alpha, int* entry) {
    const vf floor_ = splat(log_alpha_min), top = splat(ALPHA_MAX);
    int n = 0;
    for (int j = begin; j < end; j += 4) {
        vf t[4];
        Mask live[4];
#pragma GCC unroll 4
        for (int e = 0; e < 4; e++) {
            const Geometry& g = geometry_of<ROW_FLOATS>(rows, list[j + e]);
            const vf q = fma(splat(g.l3), y, splat(g.v)), p = fma(splat(g.l1), x, fma(splat(g.l2), y, splat(g.u)));
            t[e] = fnma(p, p, fnma(q, q, splat(g.log_opacity)));
            live[e] = both(alive, ge(t[e], floor_));
        }
#pragma GCC unroll 4
        for (int e = 0; e < 4; e++) {
            store(alpha[n], only(live[e], min(exp2_alpha(t[e]), top)));
            entry[n] = list[j + e];
            n += any(live[e]);
        }
    }
    return n;
}

// SLOPES: a splat's depth at a pixel is linear in the pixel.
template <int K, bool MOMENT, bool IDS, bool SLOPES> static void blend_tiles(Render& r, Outputs o) {
    constexpr int ROW_FLOATS = row_floats<K>;
    const size_t plane = r.plane(), stride = r.padded_width();
    const float log_alpha_min = __builtin_log2f(r.options.alpha_min);
    const vf stop = splat(r.options.transmittance_stop), half = splat(0.5f), zero = splat(0.f), one = splat(1.f);
#pragma omp parallel
    {
        Scratch& s = r.scratch[omp_get_thread_num()];
#pragma omp for schedule(dynamic, 1)
        for (int index = 0; index < r.tiles_x * r.tiles_y; index++) {
            const Tile tile = gather_tile<ROW_FLOATS, false, SLOPES>(r, s, index);
            const float* rows = s.rows.data;
            for (int b = 0; b < BLOCKS; b++) {
                const vf x = block_x(b), y = block_y(b);
                const int* list = &s.lists[b * s.list_capacity];
                const size_t at = block_at(tile, b, stride);
                vf sum[K], moment = zero, ref = zero, T = one, T_end = one, best = zero, median_w = zero, median_z = zero;
                vi dominant = splat(-1), median = splat(-1);
                for (auto& c : sum) c = zero;
                if (MOMENT) ref = load_block(r.reference + at, stride);
                const int count = s.counts[b];
                for (int j = 0; j < count; j += ALPHA_CHUNK) {
                    const int end = count < j + ALPHA_CHUNK ? count : j + ALPHA_CHUNK;
                    const int n = live_alphas<ROW_FLOATS>(rows, list, j, end, x, y, ge(T, stop), log_alpha_min,
                                                          s.alphas.alpha, s.alphas.entry);
                    for (int e = 0; e < n; e++) {
                        const int entry = s.alphas.entry[e];
                        const Geometry& geometry = geometry_of<ROW_FLOATS>(rows, entry);
                        const float* f = rows + size_t(entry) * ROW_FLOATS + GEOMETRY;
                        const vf a = load(s.alphas.alpha[e]);
                        const Mask on = ge(T, stop);
                        const vf w = only(on, T * a);
                        const Mask before_half = ge(T, half);
                        T = fnma(T, a, T);
                        T_end = select(on, T, T_end);
                        vf depth;
                        if constexpr (SLOPES) {
                            depth = fma(splat(f[SLOPE_V]), y, fma(splat(f[SLOPE_U]), x, splat(geometry.z)));
                            for (int c = 0; c < 3; c++) sum[c] = fma(w, splat(f[c]), sum[c]);
                            sum[3] = fma(w, depth, sum[3]);
                            for (int c = 4; c < K; c++) sum[c] = fma(w, splat(f[c]), sum[c]);
                            if (MOMENT) { const vf d = depth - ref; moment = fma(w * d, d, moment); }
                        } else {
                            for (int c = 0; c < K; c++) sum[c] = fma(w, splat(f[c]), sum[c]);
                            if (MOMENT) { const vf d = geometry.z - ref; moment = fma(w * d, d, moment); }
                        }
                        if (IDS) {
                            const vi id = splat(geometry.tag);
                            const Mask more = gt(w, best), crossing = both(before_half, gt(w, zero));
                            best = max(w, best);
                            dominant = select(more, id, dominant);
                            median = select(crossing, id, median);
                            median_w = select(crossing, w, median_w);
                            median_z = select(crossing, SLOPES ? depth : splat(geometry.z), median_z);
                        }
                    }
                    if (!any(ge(T, stop))) break;
                }
                for (int c = 0; c < K; c++) store_block(o.sums + c * plane + at, stride, sum[c]);
                store_block(o.alpha + at, stride, one - T_end);
                if (MOMENT) store_block(o.moment + at, stride, only(gt(ref, zero), moment));
                if (IDS) {
                    const Mask crossed = gt(half, T_end);
                    store_block(o.dominant_id + at, stride, dominant);
                    store_block(o.dominant_weight + at, stride, best);
                    store_block(o.median_id + at, stride, select(crossed, median, splat(-1)));
                    store_block(o.median_weight + at, stride, only(crossed, median_w));
                    if (o.median_depth) store_block(o.median_depth + at, stride, only(crossed, median_z));
                }
            }
        }
    }
}
