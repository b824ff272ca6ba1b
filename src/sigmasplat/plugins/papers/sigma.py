"""The preset `sigma` (ours): the colour variance V and the depth uncertainty U together."""

from sigmasplat.plugins.papers import varsplat

# Everything from VarSplat's preset for two CPU cores is used: σ², its likelihood and its weights. From CG-SLAM, only
# the parts that were worth their time in measurements are used: U in the loss, and fading and removing splats that
# contradict depth readings. Fading and removing keep the map usable when the camera moves fast. Two parts are not used.
# The window: a map with loops to close must keep older parts. The median-depth loss: it brings nothing in addition to
# U, and costs an eighth of the speed. There are fewer iterations, to compensate for the cost of U.
# Depth is ours: the mean depth of the splats along the ray, D̂/A, is fitted to the sensor. Seeds are discs on the
# surface. The refinement of the final map is ours, too (docs/final-map.md).
SIGMA = varsplat.FAST.changed(
    input={"denoise_depth": True},
    mapping={
        "first_iterations": 80,  # the rendered depth has no bias from here on; without D̂/A it takes 150
        "iterations": 8,  # the final map is as good as with 15; the submaps have up to 1 dB less
        "lr_pose_translation": 0.0,  # poses stay as tracked: mapping moved keyframes away from the truth
        "lr_pose_rotation": 0.0,
        "lr_log_scales": 3.5e-3,  # with 1e-2, discs on plain walls become balls: their depth is wrong from another side
        "divided": True,
        "weight_moment": 0.1,
        "weight_depth": 0.0,
        "weight_mean_depth": 2.0,
    },
    render={"depth": "ray"},
    seeding={
        "thickness": 0.1,  # the depth of a disc seen at an angle is right, and the path a little better
        "scale_factor": 0.65,  # with the slower change of sizes, larger seeds blur submaps
    },
    tracking={"features": True, "verify": True, "sensor_noise": True},
    moving={"find": True},  # up to 3 % of the time where nothing moves (benchmarks/search_cost.py)
    recovery={"relocalise": True, "new_map_after": 20, "steady_frames": 2},
    # Descent hardly ever finds a keyframe that alignment does not find, and takes half of the time of a search.
    registration={"to_keyframe": True, "iterations": 0},
    loops={"slices_per_frame": 3},
    primitives={"uncertain_m2": 0.025, "faded_opacity": 0.07},
    surface={"depth": "map+sensor"},
    uncertainty={"probes": 4},
    final={
        "iterations": 1000,
        "merge_m": 0.05,  # 40 % fewer splats than with 0.02, and no seams between neighbouring voxels
        "exposure": True,
        "order": "epochs",
        "lr_factor": 12.0,  # the rates of mapping are too small for 1000 steps: shapes hardly change
        "lr_log_scales": 8e-2,  # with half of it, views are up to 0.2 dB less sharp
        "beta2": 0.99,  # each keyframe has about a dozen steps: 0.999 remembers gradients of the merged map
        "lr_decay": 0.05,
        "lr_pose_translation": 3e-4,
        "lr_pose_rotation": 2e-4,
        "pose_reach_m": 1e-3,  # without a limit, refinement bends a path that tracking found to a millimetre
        "pose_reach_most_m": 1e-2,  # where tracking is less sure, views are 0.2 to 0.3 dB sharper
        "sh_degree": 3,
        "sh_every": 100,
        "max_needle_ratio": 8.0,
        "max_axis_ratio": 19.0,
        "weight_moment": False,  # U does not improve the final map, and costs an eighth of the time
        "prune_weight_px": 0.5,
    },
)

PRESETS = {"sigma": SIGMA}
