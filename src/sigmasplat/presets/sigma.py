"""Hold `sigma`: colour's variance V and depth's uncertainty U together. Ours; values only."""

import dataclasses

from sigmasplat.presets import varsplat

# VarSplat's for two CPU cores, whole: σ², its likelihood and its weights. Of CG-SLAM what was worth its time when
# measured: U in the loss, and splats that contradict readings fade and go - which keeps the map alive where a camera
# hurries. Not its window (a map with loops to close must not forget), not alignment (no gain beside U, an eighth of the
# speed). Iterations pay for it.
SIGMA = dataclasses.replace(
    varsplat.FAST,
    mapping=dataclasses.replace(varsplat.FAST.mapping, iterations=15, weight_moment=0.1),
    primitives=dataclasses.replace(varsplat.FAST.primitives, uncertain_m2=0.025, faded_opacity=0.07),
)

PRESETS = {"sigma": SIGMA}
