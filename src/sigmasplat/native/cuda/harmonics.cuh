// View-dependent colours on a GPU: from splats to the colours that a camera sees, and back. data/harmonics.py defines
// the functions, fit/mapping_step.py the mapping step that uses them.
#pragma once
#include "sums.cuh"

namespace sigmasplat {

constexpr int PARAMS = 17;                 // columns of GaussianField.params

#include "harmonics.h"

struct Eye { float position[3], R[9], t[3]; };   // a camera: its position, and T_camera_world

// Compute the unit direction from the camera to a splat; return the distance.
inline float direction_to(const float* mean, const Eye& eye, float* unit) {
    for (int k = 0; k < 3; k++) unit[k] = mean[k] - eye.position[k];
    const float length = sqrtf(unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2]);
    for (int k = 0; k < 3; k++) unit[k] /= fmaxf(length, 1e-12f);
    return length;
}

// Replace the colours of the splats in front of the camera by those that it sees; `rows` are initially copies of the
// splats.
KERNEL show_colors(float* rows, const float* harmonics, int n, int degree, int columns, Eye eye) {
    const int i = thread_number();
    if (i >= n) return;
    float* row = rows + size_t(i) * PARAMS;
    if (!(eye.R[6] * row[0] + eye.R[7] * row[1] + eye.R[8] * row[2] + eye.t[2] > 0.f)) return;
    float unit[3], color[3] = {row[11], row[12], row[13]};
    direction_to(row, eye, unit);
    const float* own = harmonics + size_t(i) * columns;
    each_harmonic(unit[0], unit[1], unit[2], degree, [&](int k, float value) {
        for (int c = 0; c < 3; c++) color[c] = fmaf(value, own[3 * k + c], color[c]);
    });
    for (int c = 0; c < 3; c++) row[11 + c] = color[c];
}

// Propagate the gradient of the colours, in `on_params`, to the harmonics of splats in view [n, used] (written), and by
// the viewing direction to their means (added). A camera motion ρ acts like a splat motion −ρ: the camera's gradient is
// R times the sum over the means, stored per block.
KERNEL carry_colors(const float* params, const float* harmonics, const unsigned char* visible, int n, int degree, int columns, int used,
                    Eye eye, float* on_params, float* on_harmonics, double* on_position) {
    const int i = thread_number();
    float moved[3] = {};
    if (i < n && visible[i]) {
        const float *mean = params + size_t(i) * PARAMS, *own = harmonics + size_t(i) * columns;
        float *on_row = on_params + size_t(i) * PARAMS, *on_own = on_harmonics + size_t(i) * used;
        const float shown[3] = {on_row[11], on_row[12], on_row[13]};
        float unit[3], on_unit[3] = {};
        const float length = direction_to(mean, eye, unit);
        const Dual<float> x = {unit[0], {1.f, 0.f, 0.f}}, y = {unit[1], {0.f, 1.f, 0.f}}, z = {unit[2], {0.f, 0.f, 1.f}};
        each_harmonic(x, y, z, degree, [&](int k, Dual<float> value) {
            float on_value = 0.f;
            for (int c = 0; c < 3; c++) {
                on_value = fmaf(own[3 * k + c], shown[c], on_value);
                on_own[3 * k + c] = value.value * shown[c];
            }
            for (int d = 0; d < 3; d++) on_unit[d] = fmaf(on_value, value.by[d], on_unit[d]);
        });
        const float along = unit[0] * on_unit[0] + unit[1] * on_unit[1] + unit[2] * on_unit[2];
        float on_mean[3];
        for (int d = 0; d < 3; d++) {
            on_mean[d] = (on_unit[d] - along * unit[d]) / length;
            on_row[d] += on_mean[d];
        }
        for (int d = 0; d < 3; d++)
            moved[d] = eye.R[3 * d] * on_mean[0] + eye.R[3 * d + 1] * on_mean[1] + eye.R[3 * d + 2] * on_mean[2];
    }
    store_sums<3>(moved, on_position);
}

}  // namespace sigmasplat
