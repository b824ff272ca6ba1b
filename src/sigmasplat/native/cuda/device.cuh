// The functions that splat.h needs from its number type, for one float of a GPU thread, and the layouts shared by the
// CUDA kernels. There is one program per feature count: FEATURES is defined on compilation (plugins/cuda/cubins.py lists
// the counts). A negative one is that of views whose depth is along the ray.
#pragma once
#include "sums.cuh"

namespace sigmasplat {

inline float sqrt(float x) { return sqrtf(x); }
inline float max(float a, float b) { return fmaxf(a, b); }
inline float clamp(float x, float low, float high) { return fminf(fmaxf(x, low), high); }
inline bool ge(float a, float b) { return a >= b; }
inline bool both(bool a, bool b) { return a && b; }
inline float select(bool condition, float a, float b) { return condition ? a : b; }
inline float only(bool condition, float a) { return condition ? a : 0.f; }

#include "splat.h"

constexpr int TILE = 16;                   // size in pixels, one thread per pixel: a warp is a patch of 8×4 pixels
constexpr int PATCH_WIDTH = 8, PATCH_HEIGHT = 4, PATCHES = 8;

constexpr float ALPHA_MAX = 0.99f;
constexpr float LOG2_E = 1.4426950408889634f;
// alpha = 2^(log2(o) − p² − q²), p = L1·dx + L2·dy, q = L3·dy, L = CONIC_SCALE·l.
constexpr float CONIC_SCALE = 0.8493218002880191f;    // sqrt(log2(e)/2)

// A splat as used per pixel: 8 floats of geometry, then its features, padded to whole float4s. With RAYS its depth at a
// pixel is z + slope_u·(x − u) + slope_v·(y − v), and feature DEPTH holds slope_v; else it is z, which that feature holds too.
struct Geometry { float l1, l2, l3, u, v, log_opacity, z, slope_u; };
constexpr bool RAYS = FEATURES < 0;
constexpr int COUNT = RAYS ? -FEATURES : FEATURES, DEPTH = 3;
constexpr int GEOMETRY = 8;
constexpr int SLOTS = (COUNT + 3) / 4 * 4;            // floats of features in a row
constexpr int ROW = GEOMETRY + SLOTS;
constexpr int PARAMS = 17;                            // columns of GaussianField.params

struct Box { short x0, y0, x1, y1; };                 // tiles, inclusive

struct Frame {                             // the image; every kernel takes it by value
    int width, height, tiles_x, tiles_y;
    float log_alpha_min, stop;             // log2 of alpha_min; transmittance_stop
};

// The camera is passed by value. Its pose can be in device memory instead, so that the host does not wait for it:
// `pose` is T [4, 4].
inline View<float> posed(View<float> view, const float* pose) {
    if (pose)
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) view.R[3 * i + j] = pose[4 * i + j];
            view.t[i] = pose[4 * i + 3];
        }
    return view;
}

}  // namespace sigmasplat
