// The interface of the kernels that prepare and compare images: one table of functions per instruction set. images.cpp
// fills it; bind.cpp chooses the table. Images are contiguous. Each function gives the same bytes on every instruction
// set; except for `compare`, they are those of its definition in numpy.
#pragma once
#include <cstddef>
#include <cstdint>

namespace sigmasplat {

#include "align_level.h"

// Which pixels of a depth image each row (or column) of the resized image reads. nearest: the one whose centre is
// nearest; first, second, share: the two around the centre, and the weight of the second one.
struct ResizedAxis { int size, source; const int *nearest, *first, *second; const float* share; };
// The other pixels of an area, in the order in which they replace a missing reading: `count` offsets, each with one
// source row per resized row [count, rows], and one source column per resized column [count, columns].
struct AreaOrder { int count; const int *rows, *columns; };
struct DepthRange { float least_m, most_m; };          // depth outside becomes 0

constexpr int COMPARED = 8;                            // fields of Comparison in fit/compare.py, in its order
struct CompareRules { int step, least_pixels; double noise_relative, noise_m, close_sigma, close_m, flat, hidden_m; };
struct ComparedImages {                                // of width × height; pinhole of both
    const float *reference_depth, *reference_gray, *live_depth, *live_gray;
    int width, height;
    double fx, fy, cx, cy;
    const float* color_depth;                          // of the reference, as in AlignPlanes; may be null
};

struct PointColumns { const float *x, *y, *z; int64_t count, stride; };     // stride: floats from one point to the next
struct DepthImage { const float* depth; int width, height; double fx, fy, cx, cy; };
// A place is free if all readings within radius_px are farther by clear_m plus a share of its depth.
struct FreeRules { int radius_px; double clear_m, clear_relative; };

// How depth is looked up at another time: so often; differences of one surface, a share of depth; depth where none is
// read.
struct ReadRules { int rounds; float same_surface, usual_m; };

struct ImageKernels {
    // Colour [2h, 2w, 3] to [h, w, 3] (width = w): the mean of 2×2 pixels, limited to [0, 1].
    void (*halve_color)(const float* color, int width, int height, float* half);
    void (*resize_depth)(const float* depth, ResizedAxis rows, ResizedAxis columns, float same_surface, AreaOrder, DepthRange, float* resized);
    // Colour [h, w, 3] and depth [h, w] to planes [3, rows, columns] and [rows, columns], with 0 beyond the image.
    // Returns the number of readings.
    int64_t (*image_planes)(const float* color, const float* depth, int width, int height, int rows, int columns, float* color_planes, float* depth_plane);
    // Luma [pixels] of colour [pixels, 3].
    void (*gray)(const float* color, int64_t pixels, float red, float green, float blue, float* gray);
    // Image [h, w] to [h/2, w/2]: the mean of 2×2 pixels.
    void (*halve)(const float* image, int width, int height, float* half);
    // Depth [h, w] to [h/2, w/2]: the mean of the readings in 2×2 pixels; 0 if there are less than two, or if they
    // differ by step_m or more.
    void (*halve_depth)(const float* depth, int width, int height, float step_m, float* half);
    double (*noise_scale)(const float* depth, int width, int height, CompareRules);
    // Returns false if too few pixels can be compared. readouts: null if all rows of both images were read at once.
    bool (*compare)(ComparedImages, const double* T_live_reference, const AlignReadouts* readouts, CompareRules, double* found);
    // Writes 1 for each point that the image sees through, else 0.
    void (*free_places)(PointColumns, const double* T_camera_points, DepthImage, FreeRules, uint8_t* free);
    void (*read_before)(DepthImage, Readout, ReadRules, float* before, float* color_at);
};

}  // namespace sigmasplat
