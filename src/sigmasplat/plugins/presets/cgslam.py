"""Presets of CG-SLAM.

`cgslam-*` follow the paper (ECCV 2024, arXiv 2403.16095), `cgslam-light-*` are its half-resolution variant.
`cgslam-loops-*` add the submaps, loops and final map of VarSplat to the paper's settings. `cgslam-fast` and
`cgslam-loops-fast` are ours, sized for two CPU cores.

From the paper: loss weights, iterations, intervals, window, learning rates of poses, ψ and τ. From the code, where the
paper gives no values: α_min, near plane, crops, masks, learning rates of splats, and when splats are split or removed.
Ours: `primitives.faded_opacity`, and the steps at which uncertain splats fade and are removed.
"""

import dataclasses

from sigmasplat.api import Config
from sigmasplat.plugins.presets import varsplat
from sigmasplat.plugins.presets.shared_by_papers import BASE, fixed

PAPER = BASE.changed(
    input={"min_depth_m": 0.0},  # as in the code, no reading is removed
    render={"alpha_min": 15.0 / 255.0, "near_m": 0.2},
    seeding={
        "first_uniform": 10_000_000,  # more than the number of pixels of any image: selects every pixel with a reading
        "first_gradient": 0,
        "first_edges": False,
        "later_max": 0,
        "depth_error_factor": 0.0,
        "min_distance_m": 0.0,
    },
    mapping={
        "first_iterations": 1500,
        "weight_ssim": 0.1,
        "weight_isotropy": 0.0,
        "weight_isotropy_ratio": 0.1,
        "weight_nll_color": 0.0,
        "weight_nll_depth": 0.0,
        "lr_pose_translation": 2.15e-3,
        "lr_pose_rotation": 1.5e-3,
        "adjustment": "window",
        "prune_opacity": 0.005,
        "window": 4,
    },
    primitives={"uncertain_m2": 0.025, "densify": "split+clone"},
    tracking={
        "descent": "axis-angle",
        "lr_rotation": 1.5e-3,
        "lr_translation": 2.15e-3,
        "uncertainty": False,
        "alpha_power": 0.0,
        "alpha_above": 0.99,
        "outlier_factor": 10.0,
    },
    loops={"close": False, "uncertainty": False},
    registration={"uncertainty": False},
    final={"uncertainty": False},
)
"""The settings that all data sets share."""


def sized(config: Config, extent: float, first: float = 3e-4, last: float = 2.5e-4, log_scales: float = 1e-4) -> Config:
    """Set the values that the code gives in units of the scene's extent: rates of means and scales, sizes of splats."""
    return config.changed(
        mapping={"lr_means_first": first * extent, "lr_means": last * extent, "lr_log_scales": log_scales * extent},
        primitives={"split_scale_m": 0.01 * extent},
    )


def color_share(color: float, depth: float) -> float:
    """Return λ1 / (λ1 + λ2); Adam does not depend on the scale of a loss."""
    return color / (color + depth)


# The extent is the code's value for six of Replica's eight scenes; for TUM and ScanNet it is the median of the code's
# scenes. As in the code, max_depth_m removes no reading: the PNGs end at 10, 13 and 66 m.
REPLICA = sized(
    PAPER.changed(
        input={"max_depth_m": 10.0},
        mapping={
            "every": 30, "iterations": 60, "weight_l1": 0.7, "weight_depth": 0.25, "weight_alignment": 0.25,
            "weight_moment": 0.15,
        },
        tracking={"iterations": 15, "weight_color": color_share(0.2, 1.0)},
    ),
    5.0,
)  # fmt: skip
TUM = sized(
    PAPER.changed(
        input={"max_depth_m": 13.5, "crop_px": 8},
        mapping={
            "every": 15, "iterations": 50,  # the paper says 40 to 50
            "weight_l1": 1.0, "weight_depth": 0.8, "weight_alignment": 0.5, "weight_moment": 0.5,
        },
        tracking={"iterations": 25, "weight_color": color_share(1.0, 0.6)},
    ),
    3.0,
)  # fmt: skip
SCANNET = sized(TUM.changed(input={"max_depth_m": 66.0, "crop_px": 10}), 2.0)
DATASETS = {"replica": REPLICA, "tum": TUM, "scannet": SCANNET}

# Half of 1200 and of 640. The images are cropped afterwards by as many pixels as before, as in the code for TUM.
LIGHT_WIDTHS = {"replica": 600, "tum": 320, "scannet": 320}


def _with_loops(config: Config, like: Config) -> Config:
    """Return settings with submaps, loops, registration and final map of a VarSplat preset, without weights of V."""
    plain = varsplat.without_variance(like)
    return dataclasses.replace(
        config, submaps=like.submaps, loops=plain.loops, registration=plain.registration, final=plain.final
    )


# For two CPU cores: the values of VarSplat's preset for these, except what is specific to CG-SLAM. Loss weights, ν and
# window are the paper's for Replica; but each step uses one keyframe of the window, and no splats are split.
FAST = dataclasses.replace(
    varsplat.without_variance(varsplat.FAST).changed(
        mapping={
            "weight_l1": 0.7, "weight_ssim": 0.1, "weight_depth": 0.25, "weight_alignment": 0.25,
            "weight_isotropy": 0.0, "weight_isotropy_ratio": 0.1, "weight_moment": 0.15,
            "adjustment": "single-late", "window": 4,
        },
        primitives={"uncertain_m2": 0.025},
        tracking={"align_depth_by": "U", "uncertainty": True},
    ),
    submaps=PAPER.submaps, loops=PAPER.loops, registration=PAPER.registration, final=PAPER.final,
)  # fmt: skip

PLUGIN = (
    *(fixed(f"cgslam-{name}", config) for name, config in DATASETS.items()),
    *(
        fixed(f"cgslam-light-{name}", config.changed(input={"width": LIGHT_WIDTHS[name]}))
        for name, config in DATASETS.items()
    ),
    *(fixed(f"cgslam-loops-{name}", _with_loops(config, varsplat.DATASETS[name])) for name, config in DATASETS.items()),
    fixed("cgslam-fast", FAST),
    fixed("cgslam-loops-fast", _with_loops(FAST, varsplat.FAST)),
)
