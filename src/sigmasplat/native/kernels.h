// The interface of the kernels: one table of functions per instruction set. per_instruction_set.cpp fills it;
// bind.cpp chooses at run time.
#pragma once
#include <cstddef>
#include <cstdint>

#include "image_kernels.h"

namespace sigmasplat {

struct Context;                            // buffers of one render, private to the instruction set that made it

struct PadSize { int tile_width, tile_height, lanes; };

struct BlendOptions {
    float alpha_min, transmittance_stop;
    bool ray_depth = false;                // views only; rows then hold slopes
};

struct Outputs {                           // planes of Hp × Wp, padded to whole tiles
    float* sums;                           // [K] planes
    float* moment;                         // or null
    float* alpha;
    int* median_id; float* median_weight;  // all four or none
    int* dominant_id; float* dominant_weight;
    float* median_depth = nullptr;         // with the ids, or null
};

struct OutputGradients {                   // planes like Outputs; all but sums may be null; median_id goes with median_depth
    const float *sums, *moment, *alpha;
    const int* median_id = nullptr;
    const float* median_depth = nullptr;
};

struct SplatGradients { float *means2d, *conics, *z, *opacities, *features; };

constexpr int LOSS_TERMS = 7;
struct LossWeights { float l1, depth, nll_color, nll_depth, median_depth, moment, mean_depth; };
struct DepthMaps { const float *median_depth, *moment, *alpha; };   // null where their weight is 0
struct DepthGradients { float *median_depth, *moment, *alpha; };

struct AdamOptions { const float* rates; float beta1, beta2, epsilon; int step; };   // rates: one per column
struct StepOptions { float isotropy, isotropy_ratio; int64_t frozen_colors; };
struct AdamState { float *moment1, *moment2; int* last_step; };                       // last_step: when a row was last stepped

struct ViewColors { const float* harmonics; int degree; };   // harmonics [n, 45]; degree 0: colours do not depend on the view
struct HarmonicsStep {                     // Adam's step of the harmonics, with one learning rate
    float* params; AdamState state;
    int degree, step; float rate;
};

struct Plane { int width, height; size_t stride, plane; };   // distance in floats of rows, and of image planes

struct TrackOptions {                      // settings of TrackingConfig
    float alpha_above, alpha_power, outlier_factor, outlier_factor_color, weight_color, tau, weight_max;
    bool uncertainty;
    bool kept = false;                     // errors are averaged over the used pixels, not over the image
};


struct Kernels {
    const char* name;
    PadSize pad;
    Context* (*create)();
    void (*destroy)(Context*);
    void (*project_forward)(const float* view, const float* means, const float* quats, const float* scales, int64_t n,
                            float* means2d, float* conics, float* z, float* radii, float* slopes);
    void (*project_backward)(const float* view, const float* means, const float* quats, const float* scales, int64_t n,
                             const float* radii, const float* g_means2d, const float* g_conics, const float* g_z,
                             float* g_means, float* g_quats, float* g_scales, double* g_twist);
    void (*blend_forward)(Context*, const float* means2d, const float* conics, const float* z, const float* radii,
                          const float* opacities, const float* features, int64_t n, int k, int width, int height,
                          const float* reference, BlendOptions, Outputs);
    void (*blend_backward)(Context*, OutputGradients, SplatGradients);
    // Σ_p w_ip g_p [n, k] of k ≤ 16 padded planes g, with the weights of the last forward pass.
    void (*gather)(Context*, const float* planes, int k, float* sums);
    // Fused: from rows of raw parameters [n, 17] to images of (r, g, b, z[, q, q, q]) with q = σ² + c².
    void (*view_forward)(Context*, const float* view, const float* params, ViewColors, int64_t n, int k, const float* reference,
                         BlendOptions, Outputs, double* seconds);
    // pull [n], or null: |∂L/∂mean| in the image, per half image size.
    void (*view_backward)(Context*, const float* params, OutputGradients, float* g_params, float* pull, double* g_twist,
                          double* seconds);
    // harmonics.degree: 0 without view-dependent colours.
    double (*view_step)(Context*, float* params, OutputGradients, AdamState, AdamOptions, StepOptions, HarmonicsStep harmonics,
                        float* pull, double* g_twist, double* seconds);
    void (*adam_settle)(float* params, int64_t n, AdamState, AdamOptions);
    void (*view_backward_pose)(Context*, const float* params, OutputGradients, double* g_twist, double* seconds);
    void (*view_visible)(const Context*, uint8_t* visible);
    void (*ssim_target)(const float* target, const float* mask, int width, int height, size_t stride, size_t plane, float* cache);
    double (*ssim)(const float* image, const float* target, const float* cache, int width, int height, size_t stride,
                   size_t plane, const float* mask, float weight, float* gradient);
    void (*mapping_losses)(const float* sums, const float* target_color, const float* target_depth, int height,
                           size_t stride, size_t plane, bool variance, DepthMaps, LossWeights, double valid_pixels,
                           float* g_sums, DepthGradients, double* losses);
    double (*tracking_loss)(const float* sums, const float* alpha, bool variance, const float* target_color,
                            const float* target_depth, Plane, TrackOptions, float gain, float offset, float* g_sums,
                            double* g_exposure);
    void (*reference_maps)(const float* sums, const float* alpha, const float* moment, bool variance, Plane, TrackOptions,
                           float* gray, float* depth, float* weight_gray, float* weight_depth);
    void (*align_steps)(const AlignLevel*, const AlignOptions*, const AlignReadouts*, int count, int whole, const double* T, double* normal);
    int (*align_images)(const AlignLevel*, const AlignOptions*, const AlignReadouts*, int levels, AlignLoop, double* T, double* found, int* degenerate);
    const ImageKernels* images;
};

}  // namespace sigmasplat
