"""The result of one frame, and the times of its stages."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.component import TRACKED
from sigmasplat.data.stopwatch import Stopwatch
from sigmasplat.graph.loops import Loop
from sigmasplat.render.view import View

KERNELS = ("project", "sort", "blend", "blend_backward", "project_backward")
"""The stages that `View.seconds` counts, in its order."""


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """The result of one frame: pose T_world_camera [4, 4], whether it was mapped, whether tracking was lost, results of
    tracking, the number of splats, the submap, the loops that were tried when the submap before ended, and seconds by
    stage.

    state: tracked, relocalised, lost or apart; component: that of the atlas, 0 is the world; p_off: the probability
    that the pose is off by more than 5 cm; covariance [6, 6]: `Slam.covariance()` after this frame, if `Slam.track`
    returned the step; else None.
    """

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
    state: str = TRACKED
    component: int = 0
    p_off: float = 0.0
    covariance: NDArray[np.float64] | None = None


@dataclass(eq=False)
class StepTimer(Stopwatch):
    """Wall-clock seconds of one step by stage, including the seconds of the view's kernels. The step begins with it."""

    begin_s: float = field(default_factory=time.perf_counter)
    kernels_before: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(KERNELS)))

    def start_kernels(self, view: View) -> None:
        """Measure the kernels of the view from now on."""
        self.kernels_before = view.seconds.copy()

    @contextmanager
    def kernels_of(self, view: View, name: str) -> Iterator[None]:
        """Add the time of the view's kernels in a block of code to a stage."""
        before_s = view.seconds.sum()
        yield
        self.add({name: float(view.seconds.sum() - before_s)})

    def stop(self, view: View) -> dict[str, float]:
        """Return the seconds of all stages, of the view's kernels, and in total."""
        kernels_s = (view.seconds - self.kernels_before).tolist()
        self.add(dict(zip(KERNELS, kernels_s, strict=True)) | {"total": time.perf_counter() - self.begin_s})
        return self.seconds
