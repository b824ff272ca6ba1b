// One level of two images to align, the weights of its residuals, and when steps end. Has no includes and no namespace.

struct AlignPlanes {                       // planes of width × height, contiguous; weights and noise may be null
    const float *reference_gray, *reference_depth, *weight_gray, *weight_depth, *live_gray, *live_depth;
    const float* noise;                    // factor on the Huber width of depth: σ of a reading over that of the z² law
    const float* color_depth;              // reference depth where colour was read; null: it is read at the time of depth
};
struct AlignPinhole { int width, height; float fx, fy, cx, cy; };
struct AlignLevel : AlignPlanes, AlignPinhole {};

struct AlignOptions {
    float weight_color, weight_depth;      // weights of residuals in units of their Huber widths
    float huber_gray, huber_depth_relative;
    float depth_gate;                      // metres
    float gain;                            // factor on the gray of the live image: that of its exposure
};

// When the rows of an image were read, s after the time of its colour: depth late by `late_s`; rows take `…_rows_s` from the
// first to the last, half of it before the middle. rate: twist (v, ω) of the camera per second, in its own axes.
struct Readout { float rate[6], late_s, depth_rows_s, gray_rows_s; };
struct AlignReadouts { Readout reference, live; };

struct AlignLoop { int iterations; double update_stop, plateau_stop, depth_m, degenerate_share, min_pixels; };
