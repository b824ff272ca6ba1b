"""Hold VarSplat's and LoopSplat's settings: values only, each from its paper unless marked as ours.

`varsplat-*` follow VarSplat (arXiv 2603.09673) §2–3. `loopsplat-*` are the same with every uncertainty weight off,
which is LoopSplat's front end (arXiv 2408.10154). `*-fast` are ours, sized for two CPU cores.
"""

import dataclasses

from sigmasplat.config import (
    Config,
    DensifyConfig,
    FinalConfig,
    InputConfig,
    LoopConfig,
    MappingConfig,
    RegistrationConfig,
    SeedConfig,
    SubmapConfig,
    TrackingConfig,
)

PAPER_FINAL = FinalConfig(seed_from="mesh", iterations=30_000, sh_degree=3, uncertainty=False)
"""VarSplat §7: V is unused there."""

UNCERTAIN_M = 0.02
"""The rule of accumulated uncertainty is the paper's, its limit ours: docs/varsplat.md has what it does on hololens."""

# Synthetic, exact depth. Ours: max_depth_m (the PNGs end at 10 m) and no masks, which the paper leaves open.
REPLICA = Config(
    input=InputConfig(max_depth_m=10.0),
    seeding=SeedConfig(
        first_uniform=600_000,
        first_gradient=50_000,
        later_max=0,
        alpha_below=0.6,
        depth_error_factor=40.0,
        min_distance_m=1e-7**0.5,
        opacity=0.5,
        outlier_neighbours=0,
    ),
    mapping=MappingConfig(
        every=5,
        iterations=100,
        first_iterations=1000,
        weight_nll_color=1e-4,
        weight_nll_depth=1e-4,
        freeze_old_colors=True,
        prune_opacity=0.1,
    ),
    tracking=TrackingConfig(
        iterations=60,
        lr_rotation=2e-4,
        lr_translation=2e-3,
        weight_color=0.95,
        tau=10.0,
        weight_max=3.0,
        alpha_above=0.0,
        outlier_factor=0.0,
    ),
    submaps=SubmapConfig(distance_m=0.5, angle_deg=50.0, uncertainty_m=UNCERTAIN_M),
    registration=RegistrationConfig(lr_translation=1e-3, lr_rotation=3e-3, tau=10.0),
    final=PAPER_FINAL,
)

# Kinect v1. Ours: max_depth_m, beyond which its readings scatter by 10 cm. The masks are the paper's options, on.
TUM = Config(
    input=InputConfig(max_depth_m=8.0),
    seeding=SeedConfig(
        first_uniform=100_000,
        first_gradient=50_000,
        later_max=30_000,
        alpha_below=0.6,
        depth_error_factor=40.0,
        min_distance_m=1e-4**0.5,
        opacity=0.5,
        outlier_neighbours=40,
    ),
    mapping=MappingConfig(
        every=1,
        iterations=100,
        first_iterations=100,
        weight_nll_color=1e-4,
        weight_nll_depth=0.0,
        freeze_old_colors=True,
        prune_opacity=0.5,
    ),
    tracking=TrackingConfig(
        iterations=200,
        lr_rotation=2e-3,
        lr_translation=1e-2,
        weight_color=0.6,
        tau=50.0,
        weight_max=3.0,
        alpha_above=0.98,
        outlier_factor=50.0,
    ),
    submaps=SubmapConfig(distance_m=0.5, angle_deg=50.0, uncertainty_m=UNCERTAIN_M),
    final=PAPER_FINAL,
)

# As TUM, with exposure and submaps of 50 frames. Ours: tau, which the paper gives for Replica and TUM only.
SCANNET = dataclasses.replace(
    TUM,
    tracking=dataclasses.replace(TUM.tracking, exposure=True),
    submaps=SubmapConfig(frames=50, uncertainty_m=UNCERTAIN_M),
)

# Two CPU cores. λ_d, λ_r, the 0.8 L1 + 0.2 SSIM, σ²'s start, w_max and tau are the paper's (Replica). Ours, and why:
FAST = Config(
    input=InputConfig(width=320, max_depth_m=8.0),  # a quarter of the pixels; the render's cost follows them
    seeding=SeedConfig(
        first_uniform=40_000,  # half of 320×240: more splats than that add cost, not accuracy
        first_gradient=15_000,
        first_edges=False,  # the gradient's draw finds the same pixels
        later_max=0,
        density=0.35,  # of the pixels a keyframe adds: with all of them ATE and PSNR stay, time does not
        depth_error_least_m=0.1,  # 40 × a median of 2 mm would call the sensor's noise a new surface
        scale_from="pixel",  # a neighbour search over the map costs more than a keyframe's fit
        scale_factor=0.8,
        opacity=0.8,  # a seed is a reading: near opaque at once, the map can be tracked on after few iterations
        max_splats=250_000,
    ),
    mapping=MappingConfig(
        every=5,  # Replica's; on every frame mapping would take five times as long
        overlap_below=0.7,  # … sooner when the camera moves fast
        iterations=18,  # what two cores can do beside the camera (docs/kernels.md: what 5, 10 and 30 buy)
        newest_probability=0.2,  # with so few, older keyframes would be forgotten at 0.4: 1 dB on redkitchen
        first_iterations=150,  # a raw map renders a centimetre too near until about then
        weight_nll_color=1e-2,  # ×100: V then follows the errors better; it pulls at shapes and poses a little too
        lr_log_variances=2e-2,  # twenty iterations must bring σ² as far as the paper's hundreds
        lr_means=2e-4,
        lr_opacity_logits=0.02,  # seeds start near opaque, and steps of 0.05 scatter them again
        lr_log_scales=1e-2,
        lr_pose_translation=2e-4,  # the new keyframe settles into the map: livingroom's ATE falls by a third
        lr_pose_rotation=1e-4,
        prune_opacity=0.05,
    ),
    primitives=DensifyConfig(split_radius_px=13.0),  # or a map that submaps inherit coarsens as the camera walks on
    tracking=TrackingConfig(
        method="align",  # Gauss–Newton on images instead of 200 renders a frame
        align_to="keyframe",
        align_weight_color=0.1,  # gray has the narrower basin; at 0.5 steps of 5° fail
        tau=10.0,
        weight_max=3.0,
    ),
    submaps=SubmapConfig(
        distance_m=0.5,
        angle_deg=50.0,
        uncertainty_m=UNCERTAIN_M,
        inherit=True,  # a new submap from nothing costs two seconds of first iterations
    ),
    loops=LoopConfig(
        similarity_floor=0.8,  # what the built-in descriptor needs: it knows no places, only shapes
        near_m=0.5,  # … and sees a revisit from another side too rarely
        most=3,  # a pair costs as much as thirty frames
    ),
    registration=RegistrationConfig(
        iterations=6,  # four keyframes a pair: each step is a render; Gauss–Newton has done most of it
        lr_translation=1e-3,
        lr_rotation=1e-3,
        tau=10.0,
    ),
    final=FinalConfig(iterations=1500),  # half a minute; with 500 livingroom keeps 2 dB less
)

DATASETS = {"replica": REPLICA, "tum": TUM, "scannet": SCANNET, "fast": FAST}


def without_variance(config: Config) -> Config:
    """Switch off every weight that V has: tracking's, loops', registration's, and the likelihoods that train it."""
    return dataclasses.replace(
        config,
        tracking=dataclasses.replace(config.tracking, uncertainty=False),
        mapping=dataclasses.replace(config.mapping, weight_nll_color=0.0, weight_nll_depth=0.0),
        loops=dataclasses.replace(config.loops, uncertainty=False),
        registration=dataclasses.replace(config.registration, uncertainty=False),
        final=dataclasses.replace(config.final, uncertainty=False),
        submaps=dataclasses.replace(config.submaps, uncertainty_m=0.0),
    )


PRESETS = {f"varsplat-{dataset}": config for dataset, config in DATASETS.items()} | {
    f"loopsplat-{dataset}": without_variance(config) for dataset, config in DATASETS.items()
}
