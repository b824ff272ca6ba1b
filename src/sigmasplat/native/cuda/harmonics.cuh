// View-dependent colours on a GPU: from splats to the colours that a camera sees, and back. model/harmonics.py defines
// the functions, fit/view_dependent.py the mapping step that uses them.
#pragma once
#include "sums.cuh"

namespace sigmasplat {

constexpr int PARAMS = 17;                 // columns of GaussianField.params

struct Dual { float value, by[3]; };       // a number and its derivatives with respect to x, y, z
inline Dual operator+(Dual a, Dual b) { return {a.value + b.value, {a.by[0] + b.by[0], a.by[1] + b.by[1], a.by[2] + b.by[2]}}; }
inline Dual operator-(Dual a, Dual b) { return {a.value - b.value, {a.by[0] - b.by[0], a.by[1] - b.by[1], a.by[2] - b.by[2]}}; }
inline Dual operator*(float a, Dual b) { return {a * b.value, {a * b.by[0], a * b.by[1], a * b.by[2]}}; }
inline Dual operator*(Dual a, Dual b) {
    return {a.value * b.value, {a.by[0] * b.value + a.value * b.by[0], a.by[1] * b.value + a.value * b.by[1],
                                a.by[2] * b.value + a.value * b.by[2]}};
}

// Call take(number, value) for each harmonic of degrees 1 to `degree` in the direction (x, y, z), in order.
template <class Number, class Take> inline void each_harmonic(Number x, Number y, Number z, int degree, Take take) {
    const float a1 = 0.4886025119029199f;                                  // √(3/4π)
    take(0, -a1 * y); take(1, a1 * z); take(2, -a1 * x);
    if (degree < 2) return;
    const float a2 = 1.0925484305920792f, b2 = 0.31539156525252005f;       // √(15/4π), √(5/16π)
    const Number xx = x * x, yy = y * y, zz = z * z, both = xx + yy, apart = xx - yy;
    take(3, a2 * (x * y)); take(4, -a2 * (y * z)); take(5, b2 * (2.f * zz - both)); take(6, -a2 * (x * z)); take(7, 0.5f * a2 * apart);
    if (degree < 3) return;
    const float a3 = 0.5900435899266435f, b3 = 1.445305721320277f,         // √(35/32π), √(210/32π)
        c3 = 0.4570457994644658f, d3 = 0.3731763325901154f;                // √(21/32π), √(14/32π)
    take(8, -a3 * (y * (3.f * xx - yy)));
    take(9, 2.f * b3 * (x * y * z));
    take(10, -c3 * (y * (4.f * zz - both)));
    take(11, d3 * (z * (2.f * zz - 3.f * both)));
    take(12, -c3 * (x * (4.f * zz - both)));
    take(13, b3 * (z * apart));
    take(14, -a3 * (x * (xx - 3.f * yy)));
}

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
        const Dual x = {unit[0], {1.f, 0.f, 0.f}}, y = {unit[1], {0.f, 1.f, 0.f}}, z = {unit[2], {0.f, 0.f, 1.f}};
        each_harmonic(x, y, z, degree, [&](int k, Dual value) {
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
