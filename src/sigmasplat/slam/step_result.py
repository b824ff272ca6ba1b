"""Tell what one frame brought."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.fit.pose import PoseFit
from sigmasplat.slam.loop_closure.closer import Loop

KERNELS = ("project", "sort", "blend", "blend_backward", "project_backward")
"""What `View.seconds` counts, in its order."""


@dataclass(frozen=True, eq=False)
class Step:
    """What one frame brought: its pose T_world_camera [4, 4], whether it was mapped, whether it was lost, its submap,
    the loops looked for when the submap before was finished, numbers."""

    index: int
    timestamp_s: float
    T_world_camera: NDArray[np.float64]
    is_keyframe: bool
    lost: bool
    tracking: dict[str, float]
    splats: int
    submap: int = 0
    loops: tuple[Loop, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


def metrics_of(fit: PoseFit) -> dict[str, float]:
    """Return what a step tells of its tracking."""
    return {
        "agreement": fit.agreement, "overlap": fit.overlap, "first_loss": fit.first_loss,
        "loss": fit.loss, "iterations": float(fit.iterations),
    }  # fmt: skip
