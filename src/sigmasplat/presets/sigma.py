"""Hold `sigma`: colour's variance V and depth's uncertainty U together. Ours; values only."""

import dataclasses

from sigmasplat.config import PrimitiveConfig
from sigmasplat.presets import varsplat

# VarSplat's for two CPU cores, whole: σ², its likelihood and its weights. Of CG-SLAM what shapes the map, cautiously:
# its terms at less than half their weight beside depth, its window twice as wide.
SIGMA = dataclasses.replace(
    varsplat.FAST,
    mapping=dataclasses.replace(
        varsplat.FAST.mapping, weight_alignment=0.1, weight_moment=0.1, window=8, covisibility="splats"
    ),
    primitives=PrimitiveConfig(uncertain_m2=0.025, faded_opacity=0.07),
)

PRESETS = {"sigma": SIGMA}
