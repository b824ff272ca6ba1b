// Render splats on a GPU: project them, list for every tile the splats that reach it, blend. Description:
// docs/kernels.md.
#include "tiles.cuh"

namespace sigmasplat {

inline Shape<float> shape_at(const float* means, const float* quats, const float* scales, int i) {
    Shape<float> s;
    for (int k = 0; k < 3; k++) s.mean[k] = means[3 * size_t(i) + k];
    for (int k = 0; k < 4; k++) s.quat[k] = quats[4 * size_t(i) + k];
    for (int k = 0; k < 3; k++) s.scale[k] = scales[3 * size_t(i) + k];
    return s;
}

KERNEL project_splats(View<float> view, const float* pose, const float* means, const float* quats, const float* scales, int n,
                      float* means2d, float* conics, float* z, float* radii) {
    const int i = thread_number();
    if (i >= n) return;
    view = posed(view, pose);
    const Footprint<float> f = project(view, shape_at(means, quats, scales, i), view.near_m);
    const bool seen = f.z > view.near_m;
    means2d[2 * size_t(i)] = only(seen, f.u); means2d[2 * size_t(i) + 1] = only(seen, f.v);
    conics[3 * size_t(i)] = only(seen, f.l1); conics[3 * size_t(i) + 1] = only(seen, f.l2); conics[3 * size_t(i) + 2] = only(seen, f.l3);
    z[i] = f.z;
    radii[2 * size_t(i)] = only(seen, sqrtf(f.var_u)); radii[2 * size_t(i) + 1] = only(seen, sqrtf(f.var_v));
}

// ---- splats to rows -------------------------------------------------------------------------------------------------

KERNEL pack_given(const float* means2d, const float* conics, const float* z, const float* radii, const float* opacities,
                  const float* given, int n, int used, Frame frame, Packed to) {
    const int i = thread_number();
    if (i >= n) return;
    Footprint<float> f;
    f.u = means2d[2 * size_t(i)]; f.v = means2d[2 * size_t(i) + 1];
    f.l1 = conics[3 * size_t(i)]; f.l2 = conics[3 * size_t(i) + 1]; f.l3 = conics[3 * size_t(i) + 2];
    f.z = z[i];
    f.var_v = 1.f / (f.l3 * f.l3);
    f.var_u = (f.l2 * f.l2 * f.var_v + 1.f) / (f.l1 * f.l1);
    f.slope_u = 0.f;
    float features[SLOTS];
    for (int c = 0; c < SLOTS; c++) features[c] = c < used ? given[size_t(i) * used + c] : 0.f;
    pack(to, i, f, opacities[i], radii[2 * size_t(i)] > 0.f, frame);
    pack_features(to, i, features);
}

#if FEATURES <= 7
struct Splat { Shape<float> shape; float opacity, color[3], variance[3]; };

inline Splat activated(const float* params, int i) {  // GaussianField's columns
    const float* row = params + size_t(i) * PARAMS;
    Splat s;
    s.shape = shape_at(row, row + 3, row + 7, 0);
    for (int k = 0; k < 3; k++) s.shape.scale[k] = expf(s.shape.scale[k]);
    s.opacity = 1.f / (1.f + expf(-row[10]));
    for (int k = 0; k < 3; k++) s.color[k] = row[11 + k];
    for (int k = 0; k < 3; k++) s.variance[k] = COUNT > 4 ? expf(row[14 + k]) : 0.f;
    return s;
}

KERNEL pack_view(View<float> view, const float* pose, const float* params, int n, Frame frame, Packed to) {
    const int i = thread_number();
    if (i >= n) return;
    view = posed(view, pose);
    const Splat s = activated(params, i);
    Footprint<float> f = project(view, s.shape, view.near_m);
    if (RAYS) add_slopes(view, s.shape, view.near_m, f);
    float features[SLOTS] = {s.color[0], s.color[1], s.color[2], RAYS ? f.slope_v : f.z};
    for (int k = 4; k < COUNT; k++) features[k] = fmaf(s.color[k - 4], s.color[k - 4], s.variance[k - 4]);
    pack(to, i, f, s.opacity, f.z > view.near_m, frame);
    pack_features(to, i, features);
}
#endif

// ---- rows to lists --------------------------------------------------------------------------------------------------

// Write the (tile, splat) pairs of the splat at rank r in depth, after those of all nearer splats. A stable sort by
// tile then leaves each tile's pairs in order near to far. `first_slots`: where a splat's pairs begin, and later its
// gradients.
template <class Key>
inline void list_pairs(const long long* order, const long long* ends, const int* counts, const Box* boxes, const float* rows, int n,
                       int capacity, const Frame& frame, int* first_slots, Key* tiles, int* owners) {
    const int r = thread_number();
    if (r >= n) return;
    const int i = int(order[r]);
    long long slot = ends[r] - counts[i];
    if (!counts[i] || slot >= capacity) return;
    first_slots[i] = int(slot);
    const Geometry g = geometry_at(rows, i);
    const Box box = boxes[i];
    for (int y = box.y0; y <= box.y1; y++)
        for (int x = box.x0; x <= box.x1; x++)
            if (slot < capacity && reaches_tile(g, frame, x, y)) {   // the same arithmetic as in `pack`, so the same count
                tiles[slot] = Key(y * frame.tiles_x + x);
                owners[slot++] = i;
            }
}
KERNEL list_pairs_short(const long long* order, const long long* ends, const int* counts, const Box* boxes, const float* rows, int n,
                        int capacity, Frame frame, int* first_slots, short* tiles, int* owners) {
    list_pairs(order, ends, counts, boxes, rows, n, capacity, frame, first_slots, tiles, owners);
}
KERNEL list_pairs_int(const long long* order, const long long* ends, const int* counts, const Box* boxes, const float* rows, int n,
                      int capacity, Frame frame, int* first_slots, int* tiles, int* owners) {
    list_pairs(order, ends, counts, boxes, rows, n, capacity, frame, first_slots, tiles, owners);
}

// ---- lists to pixels ------------------------------------------------------------------------------------------------

// A tile's splats are items[tile_begin[t]] … items[tile_begin[t + 1] − 1], near to far. If there are more pairs than
// `capacity`, the lists are incomplete, and the tiles process all splats in order of depth instead: slow, but the same
// image.
struct Lists {
    const int *items, *tile_begin;
    const long long *order, *total;
    const int* counts;
    long long n, capacity;
};

struct Planes {                            // [K, H, W] and [H, W]; those not requested are null
    float *sums, *moment, *alpha;
    int* median_id; float* median_weight;
    int* dominant_id; float* dominant_weight;
    float* median_depth;
};

struct Pixel { int x, y; bool inside; size_t at; float dx, dy; };   // dx, dy: relative to the tile's centre
inline Pixel pixel_of_thread(const Frame& frame) {
    const int patch = int(threadIdx.x) / 32, lane = int(threadIdx.x) % 32;
    const int x = patch % 2 * PATCH_WIDTH + lane % PATCH_WIDTH, y = patch / 2 * PATCH_HEIGHT + lane / PATCH_WIDTH;
    Pixel p;
    p.x = int(blockIdx.x) % frame.tiles_x * TILE + x;
    p.y = int(blockIdx.x) / frame.tiles_x * TILE + y;
    p.inside = p.x < frame.width && p.y < frame.height;
    p.at = size_t(p.y) * frame.width + p.x;
    p.dx = float(x) - (TILE - 1) * 0.5f;
    p.dy = float(y) - (TILE - 1) * 0.5f;
    return p;
}

// Rows in shared memory have an odd number of float4s, so that eight threads that write one each use eight different
// banks.
constexpr int SHARED_ROW = ROW / 4 % 2 ? ROW : ROW + 4;
constexpr int BATCH = THREADS;

// log2 of a splat's alpha at a pixel before its limits. a: l1, l2, l3, U; b: V, log2(o), with p = l1·x + l2·y + U, q =
// l3·y + V.
inline float log_alpha(const float4& a, const float4& b, float dx, float dy) {
    const float q = fmaf(a.z, dy, b.x), p = fmaf(a.x, dx, fmaf(a.y, dy, a.w));
    return fmaf(-p, p, fmaf(-q, q, b.y));
}

// Store geometry relative to the centre of the tile whose corner is (x, y), in the layout of `log_alpha`; then depth there
// and slope_u. features: those of the splat.
inline void store_about_center(const Geometry& g, const float* features, float x, float y, float* to) {
    const float u = g.u - (x + (TILE - 1) * 0.5f), v = g.v - (y + (TILE - 1) * 0.5f);
    float4* row = reinterpret_cast<float4*>(to);
    row[0] = make_float4(g.l1, g.l2, g.l3, -fmaf(g.l1, u, g.l2 * v));
    const float z = RAYS ? fmaf(-features[DEPTH], v, fmaf(-g.slope_u, u, g.z)) : g.z;
    row[1] = make_float4(-g.l3 * v, g.log_opacity, z, g.slope_u);
}

// A splat's depth at a pixel, from its row in that layout, of which b is the second float4.
inline float depth_at(const float* row, const float4& b, float dx, float dy) {
    return RAYS ? fmaf(row[GEOMETRY + DEPTH], dy, fmaf(b.w, dx, b.z)) : b.z;
}
inline float feature_at(const float* row, int c, float depth) { return RAYS && c == DEPTH ? depth : row[GEOMETRY + c]; }

template <bool MOMENT, bool IDS>
inline void blend_tile(const Frame& frame, const float* rows, const Lists& lists, const float* reference, int used, const Planes& out) {
    __shared__ __align__(16) float batch[BATCH * SHARED_ROW];
    __shared__ unsigned patches[BATCH];
    __shared__ int ids[BATCH];
    const int tile = int(blockIdx.x), t = int(threadIdx.x), patch = t / 32;
    const int tile_x = tile % frame.tiles_x, tile_y = tile / frame.tiles_x;
    const bool listed = *lists.total <= lists.capacity;
    const int begin = listed ? lists.tile_begin[tile] : 0, count = listed ? lists.tile_begin[tile + 1] - begin : int(lists.n);
    const Pixel pixel = pixel_of_thread(frame);
    const float ref = MOMENT && pixel.inside ? reference[pixel.at] : 0.f;
    float sum[COUNT] = {}, moment = 0.f, light = pixel.inside ? 1.f : 0.f, best = 0.f, median_weight = 0.f, median_z = 0.f;
    int dominant = -1, median = -1;
    for (int first = 0; first < count; first += BATCH) {
        if (__syncthreads_and(!pixel.inside || light < frame.stop)) break;
        const int size = count - first < BATCH ? count - first : BATCH;
        if (t < size) {
            const int i = listed ? lists.items[begin + first + t] : int(lists.order[first + t]);
            const Geometry g = geometry_at(rows, i);
            const bool here = listed || (lists.counts[i] && reaches_tile(g, frame, tile_x, tile_y));
            ids[t] = i;
            patches[t] = here ? patches_reached(g, frame, float(tile_x * TILE), float(tile_y * TILE)) : 0u;
            const float* features = rows + size_t(i) * ROW + GEOMETRY;
            store_about_center(g, features, float(tile_x * TILE), float(tile_y * TILE), batch + t * SHARED_ROW);
            const float4* from = reinterpret_cast<const float4*>(features);
            float4* to = reinterpret_cast<float4*>(batch + t * SHARED_ROW + GEOMETRY);
            for (int c = 0; c < SLOTS / 4; c++) to[c] = from[c];
        }
        __syncthreads();
        for (int j = 0; j < size; j++) {
            if (!(patches[j] >> patch & 1u)) continue;
            const float* row = batch + j * SHARED_ROW;
            const float4 a = reinterpret_cast<const float4*>(row)[0], b = reinterpret_cast<const float4*>(row)[1];
            const float power = log_alpha(a, b, pixel.dx, pixel.dy);
            if (!(power >= frame.log_alpha_min && light >= frame.stop)) continue;
            const float alpha = fminf(exp2f(power), ALPHA_MAX), w = light * alpha;
            const float depth = depth_at(row, b, pixel.dx, pixel.dy);
            for (int c = 0; c < COUNT; c++) sum[c] = fmaf(w, feature_at(row, c, depth), sum[c]);
            if (MOMENT) {
                const float off = depth - ref;
                moment = fmaf(w * off, off, moment);
            }
            if (IDS) {
                if (w > best) { best = w; dominant = ids[j]; }
                if (light >= 0.5f) { median = ids[j]; median_weight = w; median_z = depth; }
            }
            light = fmaf(-light, alpha, light);
        }
    }
    if (!pixel.inside) return;
    const size_t plane = size_t(frame.width) * frame.height;
    for (int c = 0; c < COUNT; c++)
        if (c < used) out.sums[c * plane + pixel.at] = sum[c];
    out.alpha[pixel.at] = 1.f - light;
    if (MOMENT) out.moment[pixel.at] = only(ref > 0.f, moment);
    if (IDS) {
        const bool crossed = light < 0.5f;
        out.dominant_id[pixel.at] = dominant;
        out.dominant_weight[pixel.at] = best;
        out.median_id[pixel.at] = crossed ? median : -1;
        out.median_weight[pixel.at] = only(crossed, median_weight);
        if (out.median_depth) out.median_depth[pixel.at] = only(crossed, median_z);
    }
}

KERNEL blend(Frame frame, const float* rows, Lists lists, const float* reference, int used, Planes out) {
    blend_tile<false, false>(frame, rows, lists, reference, used, out);
}
KERNEL blend_moment(Frame frame, const float* rows, Lists lists, const float* reference, int used, Planes out) {
    blend_tile<true, false>(frame, rows, lists, reference, used, out);
}
KERNEL blend_ids(Frame frame, const float* rows, Lists lists, const float* reference, int used, Planes out) {
    blend_tile<false, true>(frame, rows, lists, reference, used, out);
}
KERNEL blend_moment_ids(Frame frame, const float* rows, Lists lists, const float* reference, int used, Planes out) {
    blend_tile<true, true>(frame, rows, lists, reference, used, out);
}

}  // namespace sigmasplat

#include "gradients.cuh"
