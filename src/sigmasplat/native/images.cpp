// Compile the kernels that prepare and compare images for one instruction set. CMake builds this file once per
// instruction set, without fused multiply-adds, so that each of them rounds as numpy does.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>

#include "image_kernels.h"
#include "lanes.h"

namespace sigmasplat::SIGMASPLAT_ISA {
namespace {

#include "buffer.h"
#include "resize.h"
#include "late_points.h"
#include "compare.h"
#include "free_space.h"
#include "read_at_once.h"

}  // namespace

extern const ImageKernels image_table;
const ImageKernels image_table = {halve_color, resize_depth, image_planes, gray, halve, halve_depth, noise_scale, compare, free_places, read_before};

}  // namespace sigmasplat::SIGMASPLAT_ISA
