// Compile every kernel for one instruction set. CMake builds this file once per instruction set, with its own flags and
// SIGMASPLAT_ISA. Only the table has external linkage, so no AVX-512 code can be linked into other code.
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <type_traits>

#include <omp.h>

#include "kernels.h"
#include "lanes.h"

namespace sigmasplat::SIGMASPLAT_ISA {
namespace {

template <int N> struct std_int { static constexpr int value = N; };
#include "buffer.h"
#include "splat.h"
#include "harmonics.h"
#include "raster_project.h"
#include "raster_sort.h"
#include "raster_bin.h"
#include "raster_blend.h"
#include "raster_blend_backward.h"
#include "raster_gather.h"
#include "adam.h"
#include "view_colors.h"
#include "losses.h"
#include "view.h"
#include "ssim.h"
#include "track.h"
#include "align.h"

Context* create() { return reinterpret_cast<Context*>(new Render); }
void destroy(Context* c) { delete reinterpret_cast<Render*>(c); }

#define SIGMA_NAME_(x) #x
#define SIGMA_NAME(x) SIGMA_NAME_(x)

}  // namespace

extern const ImageKernels image_table;  // images.cpp
extern const Kernels table;
const Kernels table = {
    SIGMA_NAME(SIGMASPLAT_ISA),
    {TILE_WIDTH, TILE_HEIGHT, W},
    create, destroy,
    project_forward, project_backward, blend_forward, blend_backward, gather_planes,
    view_forward, view_backward, view_step, adam_settle, view_backward_pose, view_visible,
    ssim_target, ssim, mapping_losses, tracking_loss, reference_maps, align_steps, align_images, &image_table,
};

}  // namespace sigmasplat::SIGMASPLAT_ISA
