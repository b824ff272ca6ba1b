"""The preset `sigma` (ours): the colour variance V and the depth uncertainty U together."""

from sigmasplat.presets import varsplat

# Everything from VarSplat's preset for two CPU cores is used: σ², its likelihood and its weights. From CG-SLAM, only
# the parts that were worth their time in measurements are used: U in the loss, and fading and removing splats that
# contradict depth readings. Fading and removing keep the map usable when the camera moves fast. Two parts are not used.
# The window: a map with loops to close must keep older parts. The median-depth loss: it brings nothing in addition to
# U, and costs an eighth of the speed. There are fewer iterations, to compensate for the cost of U.
# Depth is ours: the mean depth of the splats is fitted to the sensor, splats start as discs on the surface, and their
# depth is that along the ray. With the sizes' higher rate of `varsplat-fast` discs become round and large.
SIGMA = varsplat.FAST.changed(
    input={"denoise_depth": True},
    render={"depth": "ray"},
    seeding={"thickness": 0.2},
    mapping={
        "iterations": 15, "weight_moment": 0.1, "weight_depth": 0.0, "weight_mean_depth": 1.0, "lr_log_scales": 5e-3,
    },
    tracking={"features": True, "verify": True},
    recovery={"relocalise": True, "new_map_after": 20, "steady_frames": 2},
    primitives={"uncertain_m2": 0.025, "faded_opacity": 0.07},
    uncertainty={"probes": 4},
)  # fmt: skip

PRESETS = {"sigma": SIGMA}
