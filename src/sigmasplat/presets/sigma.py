"""The preset `sigma` (ours): the colour variance V and the depth uncertainty U together."""

from sigmasplat.presets import varsplat

# All of VarSplat's preset for two CPU cores: σ², its likelihood and its weights. From CG-SLAM only what was worth its
# time in measurements: U in the loss, and fading and removing splats that contradict depth readings. The latter keeps
# the map usable when the camera moves fast. Not used: the window, because a map with loops to close must keep older
# parts; the median-depth loss, because it brings nothing in addition to U and costs an eighth of the speed. To pay
# for U, there are fewer iterations.
SIGMA = varsplat.FAST.changed(
    mapping={"iterations": 15, "weight_moment": 0.1},
    primitives={"uncertain_m2": 0.025, "faded_opacity": 0.07},
)

PRESETS = {"sigma": SIGMA}
