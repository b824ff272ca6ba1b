// The kernels of a program as a library that tests call by name.
#include "emulation.h"

#if FEATURES > 0 || FEATURES < -1   // with depth along the ray they are negative
#include "raster.cu"
#elif FEATURES == -1
#include "align.cu"
#else
#include "fit.cu"
#endif

using namespace sigmasplat;
#define ENTRY(kernel) {#kernel, emulation::Call<kernel>::run}
static const emulation::Entry ENTRIES[] = {
#if FEATURES == -1
    ENTRY(halve_images), ENTRY(normal_equations), ENTRY(begin_alignment), ENTRY(take_align_step),
#elif !FEATURES
    ENTRY(mapping_losses), ENTRY(ssim), ENTRY(ssim_backward), ENTRY(shape_terms), ENTRY(adam),
    ENTRY(show_colors), ENTRY(carry_colors),
    ENTRY(count_errors), ENTRY(count_variances), ENTRY(count_kept), ENTRY(tracking_loss), ENTRY(drop_pairs), ENTRY(descend),
#else
    ENTRY(project_splats), ENTRY(project_splats_backward), ENTRY(pack_given), ENTRY(list_pairs_short), ENTRY(list_pairs_int),
    ENTRY(blend), ENTRY(blend_moment), ENTRY(blend_ids), ENTRY(blend_moment_ids), ENTRY(blend_backward),
    ENTRY(blend_backward_moment), ENTRY(sum_records), ENTRY(chain_given),
#if FEATURES <= 7
    ENTRY(pack_view), ENTRY(blend_backward_pose), ENTRY(chain_params), ENTRY(chain_pose),
#endif
#endif
};

extern "C" const char* emulate(const char* name, int blocks, int threads, void** parameters, unsigned order) {
    for (const emulation::Entry& entry : ENTRIES)
        if (!strcmp(entry.name, name)) return emulation::run(entry.run, blocks, threads, parameters, order);
    return "no such kernel";
}
