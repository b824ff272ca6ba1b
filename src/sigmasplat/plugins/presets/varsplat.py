"""Presets of VarSplat and LoopSplat. Numbers that the papers do not give are those of the released code; methods that
only the code has are in `released_code`.

`varsplat-*` follow VarSplat (arXiv 2603.09673) §2–3. `loopsplat-*` are the same without any uncertainty weight, which
is the front end of LoopSplat (arXiv 2408.10154). `*-fast` are ours, sized for two CPU cores. Where each number comes
from: docs/varsplat.md.
"""

from sigmasplat.api import Config
from sigmasplat.plugins.presets.shared_by_papers import BASE, fixed

UNCERTAIN_M = 0.02
"""The rule of accumulated uncertainty is the paper's, the limit is ours."""

# The settings that all data sets share. Neither the paper nor the code removes readings; the near plane is 3DGS's.
PAPER = BASE.changed(
    input={"min_depth_m": 0.0},
    render={"near_m": 0.2},
    seeding={"first_gradient": 50_000, "depth_error_factor": 40.0},
    mapping={"iterations": 100, "weight_nll_color": 1e-4, "colors": "old-frozen"},
    submaps={"distance_m": 0.5, "uncertainty_m": UNCERTAIN_M},
    loops={"descriptor": "netvlad-or-grid"},
    final={"seed_from": "mesh", "iterations": 30_000, "sh_degree": 3, "uncertainty": False},  # §7 does not use V
)

# Synthetic data with exact depth; the PNGs end at 10 m.
REPLICA = PAPER.changed(
    input={"max_depth_m": 10.0},
    seeding={"first_uniform": 600_000, "later_max": 0, "min_distance_m": 1e-7**0.5},
    mapping={"every": 5, "first_iterations": 1000, "weight_nll_depth": 1e-4, "prune_opacity": 0.1},
    tracking={
        "iterations": 60, "lr_rotation": 2e-4, "lr_translation": 2e-3, "weight_color": 0.95, "tau": 10.0,
        "alpha_above": 0.0, "outlier_factor": 50.0,
    },
    registration={"method": "paper-fine", "tau": 10.0},
)  # fmt: skip

# Kinect v1. Ours: max_depth_m, because readings scatter by 10 cm beyond it.
TUM = PAPER.changed(
    input={"max_depth_m": 8.0, "crop_px": 16},
    seeding={"first_uniform": 100_000, "later_max": 30_000, "min_distance_m": 1e-4**0.5, "outliers": "remove"},
    mapping={"every": 1, "first_iterations": 100, "weight_nll_depth": 0.0, "prune_opacity": 0.5},
    tracking={
        "iterations": 200, "lr_rotation": 2e-3, "lr_translation": 1e-2, "weight_color": 0.6, "tau": 50.0,
        "alpha_above": 0.0, "outlier_factor": 0.0,
    },
    loops={"min_interval": 3},
)  # fmt: skip

# As TUM, with exposure, masks and submaps of 50 frames. The paper gives no tau for ScanNet and ScanNet++: those of
# tracking and registration are the medians of the code's scenes.
SCANNET = TUM.changed(
    input={"crop_px": 12},
    tracking={"exposure": True, "tau": 20.0, "alpha_above": 0.98, "outlier_factor": 50.0},
    submaps={"distance_m": 0.0, "frames": 50},
    loops={"min_interval": 4},
    registration={"tau": 20.0},
)  # fmt: skip

# Images of a DSLR with the depth of a laser scan, in millimetres: the PNGs end at 66 m.
SCANNETPP = PAPER.changed(
    input={"max_depth_m": 66.0},
    seeding={"first_uniform": 400_000, "later_max": 100_000, "min_distance_m": 1e-8**0.5},
    mapping={
        "every": 2, "first_iterations": 500, "iterations": 500, "weight_nll_depth": 1e-4, "prune_opacity": 0.5,
    },
    tracking={
        "iterations": 300, "lr_rotation": 2e-3, "lr_translation": 1e-2, "weight_color": 0.5, "tau": 3.0,
        "alpha_above": 0.98, "alpha_power": 0.0, "outlier_factor": 50.0, "reinit_factor": 50.0,
    },
    submaps={"distance_m": 0.0, "frames": 100},
    loops={"min_similarity": 0.34},
    registration={"tau": 10.0},
)  # fmt: skip

# For two CPU cores. λ_d, λ_r, 0.8 L1 + 0.2 SSIM, the initial σ², w_max and tau are the paper's (Replica). The values
# below are ours; comments give the reasons.
FAST = BASE.changed(
    input={"width": 320, "max_depth_m": 8.0},  # a quarter of the pixels, which determine the cost of rendering
    seeding={
        "first_uniform": 40_000,  # half of 320×240: more splats add cost but no accuracy
        "first_gradient": 15_000,
        "first_edges": False,  # sampling by gradient finds the same pixels
        "later_max": 0,
        "depth_error_least_m": 0.1,  # 40 × a median of 2 mm alone would treat sensor noise as a new surface
        "shape": "pixel",
        "max_splats": 250_000,
    },
    mapping={
        "every": 5,  # as for Replica; mapping every frame would take five times as long
        "overlap_below": 0.7,  # more keyframes when the camera moves fast
        "iterations": 18,  # what two cores can do while the camera runs
        "few_steps": True,
        "first_iterations": 150,  # until about then, a new map renders surfaces a centimetre too close
        "weight_nll_color": 1e-2,  # ×100: V then predicts the errors better; it also affects shapes and poses a little
        "lr_means": 2e-4,
        "lr_log_scales": 1e-2,
        "lr_pose_translation": 2e-4,  # the new keyframe adapts to the map: a third less ATE on livingroom
        "lr_pose_rotation": 1e-4,
        "prune_opacity": 0.05,
    },
    primitives={"split_radius_px": 13.0},  # else an inherited map becomes coarser as the camera moves
    tracking={
        "method": "align",  # Gauss–Newton on images instead of 200 renders per frame
        "align_weight_color": 0.1,  # gray has the smaller basin of convergence; with 0.5, steps of 5° fail
        "tau": 10.0,
    },
    submaps={
        "distance_m": 0.5,
        "uncertainty_m": UNCERTAIN_M,
        "inherit": True,  # starting a submap empty costs two seconds of first iterations
    },
    loops={
        "near_m": 0.5,  # the built-in descriptor rarely recognises a place from another side
        "most": 3,  # registering a pair costs as much as thirty frames
    },
    registration={
        "iterations": 6,  # four keyframes per pair, and each step is a render; Gauss–Newton has done most of the work
        "method": "few-steps",
        "tau": 10.0,
    },
    final={"iterations": 1500},  # half a minute; 500 lose 2 dB on livingroom
)

DATASETS = {"replica": REPLICA, "tum": TUM, "scannet": SCANNET, "scannetpp": SCANNETPP, "fast": FAST}


def without_variance(config: Config) -> Config:
    """Return the settings without any use of V and without the likelihoods that train σ²."""
    off = {"uncertainty": False}
    return config.changed(
        tracking=off, loops=off, registration=off, final=off,
        mapping={"weight_nll_color": 0.0, "weight_nll_depth": 0.0}, submaps={"uncertainty_m": 0.0},
    )  # fmt: skip


PLUGIN = (
    *(fixed(f"varsplat-{name}", config) for name, config in DATASETS.items()),
    *(fixed(f"loopsplat-{name}", without_variance(config)) for name, config in DATASETS.items()),
)
