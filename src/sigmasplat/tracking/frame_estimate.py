"""The result of localising one frame, before it is mapped and recorded."""

from dataclasses import dataclass, field

from sigmasplat.data.component import LOST, TRACKED
from sigmasplat.data.hops import UNKNOWN_HOP, Hop
from sigmasplat.fit.pose import PoseFit
from sigmasplat.types import Matrix


def metrics_of(fit: PoseFit) -> dict[str, float]:
    """Return the tracking values that a step reports."""
    compared = {} if fit.comparison is None else vars(fit.comparison)
    return {
        "agreement": fit.agreement, "overlap": fit.overlap, "first_loss": fit.first_loss,
        "loss": fit.loss, "iterations": float(fit.iterations),
    } | compared  # fmt: skip


@dataclass(eq=False)
class FrameEstimate:
    """Where a frame is: T_submap_camera [4, 4] in the active submap, its state, values of tracking, whether it is to be
    mapped, the hop to it from the last keyframe, and its exposure (a, b) relative to the map."""

    T_submap_camera: Matrix
    state: str = TRACKED
    tracking: dict[str, float] = field(default_factory=dict)
    mapped: bool = False
    hop: Hop = UNKNOWN_HOP
    exposure: tuple[float, float] = (0.0, 0.0)

    @staticmethod
    def of(fit: PoseFit, T_submap_camera: Matrix, lost: bool) -> "FrameEstimate":
        """Return the result of tracking."""
        return FrameEstimate(T_submap_camera, LOST if lost else TRACKED, metrics_of(fit), exposure=fit.exposure)
