// Stage 2: footprints → for every tile, the splats that reach it, near to far.

// The tile size limits the precision of gradients. They are sums of g·x² about the tile's centre, and moving them to
// the splat's mean subtracts large numbers: on needles this costs digits in proportion to the square of the tile's
// size. 32×16 is 5 % faster, but its error on needles is above 1e-4; with 16×16 it is below.
// Another size is a build option: pip install . -C cmake.define.SIGMASPLAT_TILE_WIDTH=32
constexpr int TILE_WIDTH = SIGMASPLAT_TILE_WIDTH, TILE_HEIGHT = SIGMASPLAT_TILE_HEIGHT;
static_assert(TILE_WIDTH % 4 == 0 && TILE_HEIGHT % 4 == 0, "a tile is whole blocks");
constexpr int BLOCKS_X = TILE_WIDTH / BLOCK_WIDTH, BLOCKS_Y = TILE_HEIGHT / BLOCK_HEIGHT, BLOCKS = BLOCKS_X * BLOCKS_Y;
static_assert(BLOCKS <= 64, "a tile's blocks must fit one mask");
using BlockMask = std::conditional_t<BLOCKS <= 32, uint32_t, uint64_t>;

constexpr float LOG2_E = 1.4426950408889634f;
// Exponents have base 2: alpha = 2^t, t = log2(o) − p² − q², p = L1·dx + L2·dy, q = L3·dy, L = CONIC_SCALE·l.
constexpr float CONIC_SCALE = 0.8493218002880191f;    // sqrt(log2(e)/2)
constexpr float ALPHA_MAX = 0.99f;

// A splat as used per pixel: one row of 8 floats of geometry, then its features. `tag`: the first slot of its gradients
// among the slots of its chunk. In a tile's own copy, `tag` is the splat's number (forward) or the slot of this tile
// (backward).
struct Geometry { float l1, l2, l3, u, v, log_opacity, z; int tag; };
constexpr int GEOMETRY = sizeof(Geometry) / sizeof(float);
struct Box { uint16_t x0, y0, x1, y1; };              // in blocks, inclusive

constexpr int ALPHA_CHUNK = 32;                       // entries of a block's list processed together
typedef float Pixels[W];                              // one number per pixel of a block
struct AlphaBuffer {                                  // one chunk of a block's splats that pass the alpha test
    alignas(64) Pixels alpha[ALPHA_CHUNK + 4];
    int entry[ALPHA_CHUNK + 4];
};
struct Walk {                                         // all splats of a block that pass it, near to far: for the backward pass
    Buffer<Pixels> alpha, weight, gain;
    Buffer<int> entry;
    alignas(64) float pairs[ALPHA_CHUNK][2 * W];
    void reserve(size_t n) { alpha.reserve(n); weight.reserve(n); gain.reserve(n); entry.reserve(n); }
};
struct Center { float u, v; };
struct Scratch {                                      // buffers of one thread for its tile
    Buffer<float> rows, records;
    Buffer<Center> centers;                           // relative to the tile's centre
    Buffer<BlockMask> masks;
    Buffer<int> lists;
    Buffer<uint64_t> sorted;
    AlphaBuffer alphas;
    Walk walk;
    int counts[BLOCKS];
    size_t list_capacity = 0;
};


// With depth along the ray a row of at most eight features holds a splat's slopes in two of their places: the depth
// itself is in the geometry.
constexpr int SLOPE_U = 3, SLOPE_V = 7;

// The compiled feature counts; other counts are padded with zeros.
constexpr int feature_slots(int k) { return k <= 4 ? 4 : k <= 7 ? 7 : k <= 11 ? 11 : 16; }
// Number of floats in a row. The shortest rows fill a cache line, so that no row crosses two lines.
constexpr int floats_of_row(int k) { return k <= 8 ? 16 : GEOMETRY + (k + 3) / 4 * 4; }
template <int K> constexpr int row_floats = floats_of_row(K);
template <class F> SIGMA_INLINE void with_features(int k, F f) {   // K is compiled in: colour + depth has no cost for variance
    switch (k) {
        case 4: f(std_int<4>{}); break;
        case 7: f(std_int<7>{}); break;
        case 11: f(std_int<11>{}); break;
        default: f(std_int<16>{});
    }
}

struct Render {                                       // what a forward pass stores for its backward pass
    int64_t n = 0;
    int k = 0, used = 0, row = 0, width = 0, height = 0, tiles_x = 0, tiles_y = 0;
    View<float> view;
    BlendOptions options;
    const float* reference = nullptr;
    int64_t intersections = 0;
    Buffer<float> rows, depths, partials;             // depths are also in the rows, which are sixteen times as long
    Buffer<Box> boxes;
    Buffer<int> tiles_of, tile_begin, histogram, chunk_begin;   // chunk_begin: first slot of each chunk
    Buffer<uint64_t> items;
    Buffer<float> median_gradient;                    // with depth along the ray three numbers a splat, else one
    Scratch* scratch = nullptr;
    int threads = 0;

    ~Render() { delete[] scratch; }
    void prepare(int64_t splats, int features_used, int w, int h, BlendOptions o) {
        n = splats; used = features_used; k = feature_slots(features_used); row = floats_of_row(k); width = w; height = h; options = o;
        tiles_x = (w + TILE_WIDTH - 1) / TILE_WIDTH; tiles_y = (h + TILE_HEIGHT - 1) / TILE_HEIGHT;
        rows.reserve((n + W) * row); boxes.reserve(n + W); depths.reserve(n + W); tiles_of.reserve(n + W);
        chunk_begin.reserve(n / CHUNK + 2);
        if (threads < omp_get_max_threads()) {
            delete[] scratch;
            threads = omp_get_max_threads();
            scratch = new Scratch[threads];
        }
    }
    const Geometry& geometry(int64_t i) const { return *reinterpret_cast<const Geometry*>(&rows[size_t(i) * row]); }
    size_t padded_width() const { return size_t(tiles_x) * TILE_WIDTH; }
    size_t plane() const { return padded_width() * tiles_y * TILE_HEIGHT; }
};

// Transpose W columns at a time, first geometry and then features, into the next W floats of the rows of live splats.
template <int ROW_FLOATS, int C = 0>
SIGMA_INLINE void store_columns(float* rows, unsigned live, const vf* geometry, const float (*features)[W]) {
    if constexpr (C < ROW_FLOATS) {
        constexpr int COUNT = ROW_FLOATS - C < W ? ROW_FLOATS - C : W;
        vf turn[W];
        for (int q = 0; q < W; q++)
            turn[q] = q >= COUNT ? splat(0.f) : C + q < GEOMETRY ? geometry[C + q] : load(features[C + q - GEOMETRY]);
        transpose(turn);
        for (unsigned m = live; m; m &= m - 1) {
            const int l = __builtin_ctz(m);
            store_first<COUNT>(rows + size_t(l) * ROW_FLOATS + C, turn[l]);
        }
        store_columns<ROW_FLOATS, C + W>(rows, live, geometry, features);
    }
}

// Store W footprints and their features (lanes, padded to ROW_FLOATS - GEOMETRY features). Returns how many tiles they
// reach; `before` is the number of slots of the chunk already in use. The bounds are those of alpha ≥ alpha_min, not
// three sigma, so the image does not depend on the tiling. `fill(live)` computes the features if any splat reaches a tile.
template <int ROW_FLOATS, class Fill>
SIGMA_INLINE int pack(Render& r, const Footprint<vf>& f, vf opacity, Mask seen, int64_t i, int before, const float (*features)[W], Fill fill) {
    const vf log_opacity = log2(max(opacity, splat(1e-30f)));
    const vf reach = log_opacity - splat(__builtin_log2f(r.options.alpha_min));
    seen = both(seen, gt(reach, splat(0.f)));
    const vf radius2 = max(reach, splat(0.f)) * (2.f / LOG2_E) * 1.0002f;
    const vf du = sqrt(radius2 * f.var_u) + 1e-3f, dv = sqrt(radius2 * f.var_v) + 1e-3f;
    const int blocks_x = (r.width + BLOCK_WIDTH - 1) / BLOCK_WIDTH, blocks_y = (r.height + BLOCK_HEIGHT - 1) / BLOCK_HEIGHT;
    // Block b holds pixels b·B … b·B+B−1; clamp before converting so that huge splats cannot overflow.
    const vf x0 = clamp(-floor((float(BLOCK_WIDTH - 1) - f.u + du) * (1.f / BLOCK_WIDTH)), 0.f, float(blocks_x));
    const vf x1 = clamp(floor((f.u + du) * (1.f / BLOCK_WIDTH)), -1.f, float(blocks_x - 1));
    const vf y0 = clamp(-floor((float(BLOCK_HEIGHT - 1) - f.v + dv) * (1.f / BLOCK_HEIGHT)), 0.f, float(blocks_y));
    const vf y1 = clamp(floor((f.v + dv) * (1.f / BLOCK_HEIGHT)), -1.f, float(blocks_y - 1));
    seen = both(seen, both(ge(x1, x0), ge(y1, y0)));
    seen = both(seen, both(ge(splat(r.width - 1.f), f.u - du), ge(splat(r.height - 1.f), f.v - dv)));   // not only in padding
    const unsigned live = bits(seen) & (r.n - i < W ? (1u << (r.n - i)) - 1u : ~0u);
    memset(&r.tiles_of[i], 0, W * sizeof(int));
    store(&r.depths[i], f.z);
    if (!live) return 0;
    fill(live);
    alignas(64) int box[4][W], tag[W];
    store(box[0], to_int(x0)); store(box[1], to_int(y0)); store(box[2], to_int(x1)); store(box[3], to_int(y1));
    int used = before;
    for (unsigned m = live; m; m &= m - 1) {
        const int l = __builtin_ctz(m), bx0 = box[0][l], by0 = box[1][l], bx1 = box[2][l], by1 = box[3][l];
        r.boxes[i + l] = {uint16_t(bx0), uint16_t(by0), uint16_t(bx1), uint16_t(by1)};
        const int count = (bx1 / BLOCKS_X - bx0 / BLOCKS_X + 1) * (by1 / BLOCKS_Y - by0 / BLOCKS_Y + 1);
        r.tiles_of[i + l] = count;
        tag[l] = used;
        used += count;
    }
    const vf geometry[GEOMETRY] = {f.l1 * CONIC_SCALE, f.l2 * CONIC_SCALE, f.l3 * CONIC_SCALE, f.u, f.v,
                                   log_opacity, f.z, float_of_bits(load(tag))};
    store_columns<ROW_FLOATS>(&r.rows[size_t(i) * ROW_FLOATS], live, geometry, features);
    return used - before;
}

constexpr int LINE = 8;                               // items in a cache line

// Visit the tiles of a splat. Most splats have one or two tiles in each direction. These are visited without a branch;
// `spare` and the next two numbers replace tiles that the splat does not reach.
template <class Visit> SIGMA_INLINE void for_tiles(const Render& r, int64_t i, int spare, Visit visit) {
    const Box b = r.boxes[i];
    const int x = b.x0 / BLOCKS_X, y = b.y0 / BLOCKS_Y, right = b.x1 / BLOCKS_X - x, down = b.y1 / BLOCKS_Y - y;
    const int first = y * r.tiles_x + x;
    if (right <= 1 && down <= 1) [[likely]] {
        visit(first);
        visit(right ? first + 1 : spare);
        visit(down ? first + r.tiles_x : spare + 1);
        visit(right & down ? first + r.tiles_x + 1 : spare + 2);
        return;
    }
    for (int dy = 0; dy <= down; dy++)
        for (int dx = 0; dx <= right; dx++) visit(first + dy * r.tiles_x + dx);
}

static void number_slots(Render& r) {                 // first slot of each chunk's per-tile gradients
    const int64_t chunks = (r.n + CHUNK - 1) / CHUNK;
    int sum = 0;
    for (int64_t c = 0; c < chunks; c++) { const int t = r.chunk_begin[c]; r.chunk_begin[c] = sum; sum += t; }
    r.intersections = sum;
}

static void bin(Render& r) {
    number_slots(r);
    const int tiles = r.tiles_x * r.tiles_y, threads = omp_get_max_threads();
    const int stride = (tiles + 3 + 2 * LINE - 1) / (2 * LINE) * (2 * LINE);   // no cache line has counters of two threads
    r.tile_begin.reserve(tiles + 1);
    r.histogram.reserve(size_t(threads) * stride);
    r.items.reserve(r.intersections + LINE * (threads + 1));   // each thread's spare tiles have their own cache line
#pragma omp parallel num_threads(threads)
    {
        const int t = omp_get_thread_num(), team = omp_get_num_threads();
        const int64_t begin = r.n * t / team, end = r.n * (t + 1) / team;
        int* mine = r.histogram.data + size_t(t) * stride;
        memset(mine, 0, size_t(stride) * sizeof(int));
        for (int64_t i = begin; i < end; i++)
            if (r.tiles_of[i]) for_tiles(r, i, tiles, [&](int tile) { mine[tile]++; });
#pragma omp barrier
#pragma omp single
        {
            int sum = 0;
            for (int q = 0; q < tiles; q++) {
                r.tile_begin[q] = sum;
                for (int w = 0; w < team; w++) {
                    int& h = r.histogram[size_t(w) * stride + q];
                    const int count = h;
                    h = sum;
                    sum += count;
                }
            }
            r.tile_begin[tiles] = sum;
        }
        for (int q = tiles; q < tiles + 3; q++) mine[q] = int(r.intersections) + LINE * (t + 1);
        for (int64_t i = begin; i < end; i++)
            if (r.tiles_of[i]) {
                uint32_t depth_bits;                  // positive floats have the same order as their bits
                memcpy(&depth_bits, &r.depths[i], 4);
                const uint64_t item = uint64_t(depth_bits) << 32 | uint32_t(i);
                for_tiles(r, i, tiles, [&](int tile) {
                    int& slot = mine[tile];
                    r.items[slot] = item;
                    slot += tile < tiles;
                });
            }
#pragma omp barrier
        Scratch& s = r.scratch[t];
#pragma omp for schedule(dynamic, 4)
        for (int q = 0; q < tiles; q++) {
            const int count = r.tile_begin[q + 1] - r.tile_begin[q];
            s.sorted.reserve(count);
            sort_tile(r.items.data + r.tile_begin[q], s.sorted.data, count);
        }
    }
}
