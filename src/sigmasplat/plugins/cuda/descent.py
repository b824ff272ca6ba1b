"""Minimise the tracking loss as `fit.descent` does, on a CUDA device without the host (native/cuda/track.cuh,
descend.cuh).

An iteration is launched without waiting. Loss, gradient, pose, stop rules and the best iterate stay on the device. From
time to time the host reads the state of some iterations ago. Iterations that are launched after the descent has stopped
change nothing. Launches are recorded once and replayed together: CUDA graphs, through torch. Recorded work must not
wait for the device or read from it, and its inputs stay at the same addresses.
"""

import warnings
from collections.abc import Callable
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import (
    BETA1,
    BETA2,
    EPSILON,
    BackendError,
    Descent,
    Matrix,
    Target,
    TrackingConfig,
    descend,
    exposure_rate,
    parametrisation,
    tracking_params,
)
from sigmasplat.plugins.cuda.launch import THREADS, HostCopy, blocks_for
from sigmasplat.plugins.cuda.view import CudaView

Work = Callable[[], None]


def repeatable(work: Work, device: torch.device) -> Work:
    """Return a function that repeats some work: a graph of it, which has not run yet, or the work itself.

    The work itself is returned if graphs are not available. If recording fails, one warning gives the reason, and no
    more graphs are recorded on that device.
    """
    return work if device.type != "cuda" else _recorder(device).record(work)


class Recorder:
    """Records on one device, on its own stream. All graphs share their memory, so only the latest one may run."""

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        self._last: torch.cuda.CUDAGraph | None = None
        self._refused = False

    def record(self, work: Work) -> Work:
        """Return a function that runs a graph of some work on the current stream, or the work itself."""
        if self._refused:
            return work
        try:
            return self._recorded(work).replay
        except (RuntimeError, BackendError) as problem:
            self._refused = True
            reason = str(problem).partition("\n")[0]
            warnings.warn(f"CUDA graphs cannot be used ({reason}); kernels are launched one by one", stacklevel=3)
            return work

    def _recorded(self, work: Work) -> torch.cuda.CUDAGraph:
        graph, pool = torch.cuda.CUDAGraph(), None if self._last is None else self._last.pool()
        # torch.cuda.graph is not used: for every fit it would first wait for the device and release all cached memory.
        # "thread_local": another thread, such as the viewer's, may meanwhile call functions that are forbidden while
        # recording.
        with torch.cuda.stream(self._stream):
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
        self._last = graph  # the graph before must exist until here, because the pool is freed with its last graph
        return graph


_recorder = cache(Recorder)


MEDIANS, PASSES, DIGITS = 5, 3, 2048
"""Medians of the errors of depth and colour, and of the three channels of V. Each is found by three passes that count
11, 10 and 10 bits (native/cuda/track.cuh)."""
MOST_BLOCKS = 512
"""Maximum number of blocks for the pixels of an image."""
LOOK = 8
"""Number of iterations launched together; while they run, the host reads the result of those before."""
GRAPH_FROM = 12
"""Minimum number of remaining iterations for a CUDA graph; with fewer, recording costs more than it saves."""
STATE = np.dtype(
    [
        ("numbers", "f8", 7), ("moment1", "f8", 9), ("moment2", "f8", 9), ("largest", "f8", 9), ("amsgrad", "f8"),
        ("exposure", "f8", 2), ("best_exposure", "f8", 2), ("T", "f8", (3, 4)), ("best_T", "f8", (3, 4)),
        ("first", "f8"), ("best", "f8"), ("lowered", "f8"), ("waited", "i8"), ("steps", "i8"), ("stopped", "i8"),
        ("missing", "i8"),
    ]
)  # fmt: skip
"""The layout of the kernels' `Descending` (native/cuda/descend.cuh)."""


def descend_on_device(
    params: Tensor, view: CudaView, target: Target, T_camera_world: Matrix, config: TrackingConfig, iterations: int
) -> Descent:
    """Minimise the tracking loss as `descend` does; colour at textured pixels alone runs on the host. Raises
    BackendError if there are too many pairs of splats and tiles."""
    if target.textured is not None:
        return descend(params, view, target, T_camera_world, config, iterations)
    if view.raster.capacity is None:
        view.forward(params, T_camera_world)  # measures how many pairs to expect
    return CudaDescent(params, view, target, T_camera_world, config).run(iterations)


class CudaTrackingLoss:
    """L_track of a view's planes against a target, with an exposure (exp(a), b), float32 [2] on the device."""

    def __init__(self, view: CudaView, target: Target, config: TrackingConfig, exposure: Tensor) -> None:
        c, empty, pixels = config, view.raster.empty, view.alpha.numel()
        self.view, self.blocks = view, min(blocks_for(pixels), MOST_BLOCKS)
        self._errors = c.outlier_factor > 0 or c.outlier_factor_color > 0
        self._weigh, self._kept = c.uncertainty and len(view.sums) == 7, c.average == "kept"
        self._tally = empty(MEDIANS * PASSES * DIGITS + 2, dtype=torch.int32)
        self.selection = (self._tally, empty(MEDIANS, PASSES, 2, dtype=torch.int32))
        images = (view.sums, view.alpha, target.color, target.depth, pixels, self.blocks * THREADS)
        self._given = (images, np.array(tracking_params(c, c.alpha_above), np.float32), exposure, self.selection)

    def launch(self) -> Tensor:
        """Write the gradient to the view's planes. Return loss and gradient with respect to (a, b) per block [blocks,
        3]."""
        self._tally.zero_()
        for kernel in ["count_errors"] * self._errors + ["count_variances"] * self._weigh:
            for digit in range(PASSES):
                self._on_pixels(kernel, digit)
        kept = self._tally[-2:] if self._kept else None
        if kept is not None:
            self._on_pixels("count_kept", kept)
        sums = self.view.raster.empty(self.blocks, 3, dtype=torch.float64)
        planes = self.view.g_sums
        self._on_pixels("tracking_loss", kept, int(self._weigh), len(planes), planes, sums)
        return sums

    def _on_pixels(self, kernel: str, *further: Tensor | int | None) -> None:
        self.view.raster.launch_fit(kernel, self.blocks, *self._given, *further)


class CudaDescent:
    """One descent and its buffers on the device."""

    def __init__(
        self, params: Tensor, view: CudaView, target: Target, T_camera_world: Matrix, config: TrackingConfig
    ) -> None:
        self.params, self.view, self.config = params.contiguous(), view, config
        self._axis = int(config.parametrisation == "axis-angle")
        state, device = _at_rest(T_camera_world, config), view.alpha.device
        self._state = torch.from_numpy(np.frombuffer(state.tobytes(), np.int64).copy()).to(device)
        self._shown = torch.from_numpy(_shown(state["T"])).to(device)
        self._numbers = _settings(T_camera_world, config)
        self._pose = self._shown[:16]
        self.loss = CudaTrackingLoss(view, target, config, self._shown[16:])

    def run(self, iterations: int) -> Descent:
        """Take at most this many steps. If there is not enough memory for all pairs, allocate more and continue from
        the step that was not taken."""
        work, left, at_once, look = self.iterate, iterations, 1, HostCopy(self._state)
        while left:
            for _ in range(min(at_once, left)):
                work()
            left -= min(at_once, left)
            earlier, look, at_once = look, HostCopy(self._state), LOOK
            seen = _state_of(earlier if left else look)
            if seen["stopped"]:
                break
            if seen["missing"]:
                now = _state_of(HostCopy(self._state))
                self.view.raster.expect(int(now["missing"]))
                self._state[-1] = 0
                work, left, look = self.iterate, iterations - int(now["steps"]), HostCopy(self._state)
            if work == self.iterate and self.config.cuda_graphs and left >= GRAPH_FROM:
                work = repeatable(self.iterate, self.view.alpha.device)
        state = _state_of(look)
        T, (a, b) = np.vstack([state["best_T"], [0.0, 0.0, 0.0, 1.0]]), state["best_exposure"].tolist()
        return Descent(T, (a, b), float(state["first"]), float(state["best"]), int(state["steps"]))

    def iterate(self) -> None:
        """Launch one iteration."""
        self.view.follow(self.params, self._pose)
        losses = self.loss.launch()
        twists = self.view.follow_back(self.params, self._pose)
        self.view.raster.launch_fit(
            "descend", 1, self._state, self._shown, self._numbers, self._axis, losses, len(losses), twists, len(twists),
            self.view.raster.pairs,
        )  # fmt: skip


def _state_of(copied: HostCopy) -> np.void:
    """Return the descent's state as a `STATE`. Waits until the copy has finished."""
    state: np.void = np.frombuffer(copied.read().tobytes(), STATE)[0]
    return state


def _at_rest(T_camera_world: Matrix, config: TrackingConfig) -> NDArray[np.void]:
    way, state = parametrisation(config, T_camera_world), np.zeros((), STATE)
    numbers, state["amsgrad"] = way.start, config.amsgrad
    state["numbers"][: len(numbers)], state["T"], state["best_T"] = numbers, way.pose(numbers)[:3], T_camera_world[:3]
    state["first"] = state["best"] = state["lowered"] = np.inf
    return state


def _shown(T: Matrix) -> NDArray[np.float32]:
    """Return the kernels' `Shown` for a pose [3, 4]: T_camera_world [4, 4], without exposure."""
    return np.concatenate([T.ravel(), [0, 0, 0, 1], [1, 0]]).astype(np.float32)


def _settings(T_camera_world: Matrix, config: TrackingConfig) -> Matrix:
    """Return the kernels' `DescentNumbers`."""
    c = config
    rates = [c.lr_rotation, c.lr_translation, exposure_rate(c)]
    stops = [0.0, c.plateau_stop, c.plateau_window]  # no step is so small that the descent ends
    return np.array([*T_camera_world[:3].ravel(), BETA1, BETA2, EPSILON, *rates, *stops], np.float64)
