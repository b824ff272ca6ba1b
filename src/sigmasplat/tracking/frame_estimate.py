"""The result of localising one frame, before it is mapped and recorded."""

from dataclasses import dataclass

from sigmasplat.data import se3
from sigmasplat.data.trajectory import LOST, TRACKED
from sigmasplat.fit.align import Alignment
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.pose import PoseFit
from sigmasplat.types import Matrix


@dataclass(eq=False)
class FrameEstimate:
    """Where a frame is: T_submap_camera [4, 4] in the active submap, its state, and whether it is to be mapped.

    fit: of tracking, None for the first frame; comparison: with the map at the pose, if it was made;
    alignment: to the newest keyframe, if it is to be mapped; inliers: matches of the relocalisation; drift_m: of the
    submap, if a rule reads it; doubt: the probability that the place of the keyframe it was fitted to is wrong.
    """

    T_submap_camera: Matrix
    state: str = TRACKED
    mapped: bool = False
    fit: PoseFit | None = None
    comparison: Comparison | None = None
    alignment: Alignment | None = None
    inliers: int | None = None
    drift_m: float | None = None
    doubt: float = 0.0

    @staticmethod
    def of(fit: PoseFit, lost: bool) -> "FrameEstimate":
        """Return the result of tracking."""
        state = LOST if lost else TRACKED
        return FrameEstimate(se3.inverse(fit.T_camera_world), state, fit=fit, comparison=fit.comparison)

    @property
    def exposure(self) -> tuple[float, float]:
        """Return the exposure (a, b) of the frame relative to the map."""
        return (0.0, 0.0) if self.fit is None else self.fit.exposure

    def logged(self) -> dict[str, float]:
        """Return the values by the names of the log; what is not known is left out."""
        fit, values = self.fit, {"doubt": self.doubt}
        if fit is not None:
            values |= {"agreement": fit.agreement, "overlap": fit.overlap, "first_loss": fit.first_loss}
            values |= {"loss": fit.loss, "iterations": float(fit.iterations)}
        if self.comparison is not None:
            values |= vars(self.comparison)
        found = {"drift_m": self.drift_m, "inliers": self.inliers}
        return values | {name: float(value) for name, value in found.items() if value is not None}
