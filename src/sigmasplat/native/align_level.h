// One level of two images to align, how its residuals are weighed, and when steps end. Includes nothing and opens no namespace.

struct AlignPlanes {                       // of width × height, one float after the other; weights may be null
    const float *reference_gray, *reference_depth, *weight_gray, *weight_depth, *live_gray, *live_depth;
};
struct AlignPinhole { int width, height; float fx, fy, cx, cy; };
struct AlignLevel : AlignPlanes, AlignPinhole {};

struct AlignOptions {
    float weight_color, weight_depth;      // of residuals measured in units of their Huber widths
    float huber_gray, huber_depth_relative;
    float depth_gate;                      // metres
};

struct AlignLoop { int iterations; double update_stop, plateau_stop, depth_m, degenerate_share, min_pixels; };
