// Which splats reach which pixels. The bounds are those of alpha ≥ alpha_min, not of three sigma, so that the image
// does not depend on tiles.
#pragma once
#include "device.cuh"

namespace sigmasplat {

// p² + q² at (x, y) from the splat's mean, minus the largest rounding error: on needles the terms of p cancel.
inline float fall(const Geometry& g, float x, float y) {
    const float a = g.l1 * x, b = g.l2 * y, q = g.l3 * y;
    const float p = fmaxf(fabsf(a + b) - 1e-6f * (fabsf(a) + fabsf(b)), 0.f);
    return fmaf(p, p, q * q);
}

// Return whether alpha can reach alpha_min in the rectangle of pixels from (x0, y0) to (x1, y1), inclusive. If the mean
// is outside the rectangle, the minimum of p² + q² is on an edge, where it is a parabola.
inline bool reaches(const Geometry& g, const Frame& frame, float x0, float y0, float x1, float y1) {
    const float left = x0 - g.u, right = x1 - g.u, top = y0 - g.v, bottom = y1 - g.v;
    if (left <= 0.f && right >= 0.f && top <= 0.f && bottom >= 0.f) return true;
    const float along_x = -g.l2 / g.l1, along_y = -g.l1 * g.l2 / fmaf(g.l2, g.l2, g.l3 * g.l3);
    const float least = fminf(
        fminf(fall(g, clamp(along_x * top, left, right), top), fall(g, clamp(along_x * bottom, left, right), bottom)),
        fminf(fall(g, left, clamp(along_y * left, top, bottom)), fall(g, right, clamp(along_y * right, top, bottom))));
    return least <= fmaf(g.log_opacity - frame.log_alpha_min, 1.0002f, 1e-3f);
}
inline bool reaches_tile(const Geometry& g, const Frame& frame, int x, int y) {
    const float x0 = float(x * TILE), y0 = float(y * TILE);
    return reaches(g, frame, x0, y0, fminf(x0 + (TILE - 1), float(frame.width - 1)), fminf(y0 + (TILE - 1), float(frame.height - 1)));
}

// Return a mask: bit w is set if the splat can reach the patch of warp w in the tile whose corner is (x, y).
inline unsigned patches_reached(const Geometry& g, const Frame& frame, float x, float y) {
    unsigned mask = 0;
    for (int w = 0; w < PATCHES; w++) {
        const float px = x + float(w % 2 * PATCH_WIDTH), py = y + float(w / 2 * PATCH_HEIGHT);
        if (reaches(g, frame, px, py, px + (PATCH_WIDTH - 1), py + (PATCH_HEIGHT - 1))) mask |= 1u << w;
    }
    return mask;
}

struct Packed { float* rows; Box* boxes; int* counts; float* depths; unsigned char* visible; };

// Store a splat's geometry, the box of tiles that its bounds meet, how many of them it really reaches, and the depth
// for sorting: infinite if it reaches none.
inline void pack(const Packed& to, int i, const Footprint<float>& f, float opacity, bool seen, const Frame& frame) {
    const float log_opacity = log2f(fmaxf(opacity, 1e-30f)), slope_u = RAYS ? f.slope_u : 0.f;
    Geometry g = {f.l1 * CONIC_SCALE, f.l2 * CONIC_SCALE, f.l3 * CONIC_SCALE, f.u, f.v, log_opacity, f.z, slope_u};
    const float reach = g.log_opacity - frame.log_alpha_min, radius2 = fmaxf(reach, 0.f) * (2.f / LOG2_E) * 1.0002f;
    const float du = sqrtf(radius2 * f.var_u) + 1e-3f, dv = sqrtf(radius2 * f.var_v) + 1e-3f;
    seen = seen && reach > 0.f && f.u + du >= 0.f && f.v + dv >= 0.f && f.u - du <= frame.width - 1.f && f.v - dv <= frame.height - 1.f;
    to.visible[i] = seen;
    int count = 0;
    if (seen) {                            // clamped before converting, so that huge splats cannot overflow
        const float per_tile = 1.f / TILE;
        const Box box = {short(clamp(ceilf((f.u - du - (TILE - 1)) * per_tile), 0.f, frame.tiles_x - 1.f)),
                         short(clamp(ceilf((f.v - dv - (TILE - 1)) * per_tile), 0.f, frame.tiles_y - 1.f)),
                         short(clamp(floorf((f.u + du) * per_tile), 0.f, frame.tiles_x - 1.f)),
                         short(clamp(floorf((f.v + dv) * per_tile), 0.f, frame.tiles_y - 1.f))};
        for (int y = box.y0; y <= box.y1; y++)
            for (int x = box.x0; x <= box.x1; x++) count += reaches_tile(g, frame, x, y);
        to.boxes[i] = box;
    }
    to.counts[i] = count;
    to.depths[i] = count ? f.z : __int_as_float(0x7f800000);
    float4* row = reinterpret_cast<float4*>(to.rows + size_t(i) * ROW);
    row[0] = make_float4(g.l1, g.l2, g.l3, g.u);
    row[1] = make_float4(g.v, g.log_opacity, g.z, g.slope_u);
}
inline void pack_features(const Packed& to, int i, const float* features) {   // SLOTS features
    float4* row = reinterpret_cast<float4*>(to.rows + size_t(i) * ROW + GEOMETRY);
    for (int c = 0; c < SLOTS / 4; c++) row[c] = make_float4(features[4 * c], features[4 * c + 1], features[4 * c + 2], features[4 * c + 3]);
}

inline Geometry geometry_at(const float* rows, int i) {
    const float4* row = reinterpret_cast<const float4*>(rows + size_t(i) * ROW);
    const float4 a = row[0], b = row[1];
    return {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w};
}

}  // namespace sigmasplat
