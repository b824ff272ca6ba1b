"""Define the operations that the CPU benchmark times on one scene, each as the product runs it."""

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
import torch
from scenes import Scene
from torch import Tensor

from sigmasplat.config import RenderConfig
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.data.field import GaussianField
from sigmasplat.fit import losses
from sigmasplat.fit.backends import fits_of
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.pose import fit_pose_adam, fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import keyframe_reference, map_reference
from sigmasplat.fit.target import Keyframe, Target, gray_of
from sigmasplat.native import _core
from sigmasplat.render import cpu as _cpu  # noqa: F401 # applies the switches before anybody sets them
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.kernels import view_params

RENDER = RenderConfig(depth="center")
ADAM_ITERATIONS = 60
STAGES = ("project", "sort", "blend", "blend backward", "project backward")


@dataclass(frozen=True)
class Timing:
    """Median and shortest time of `runs` runs, milliseconds."""

    median_ms: float
    min_ms: float
    runs: int

    @staticmethod
    def of(seconds: list[float]) -> "Timing":
        """Summarise single times."""
        return Timing(1e3 * float(np.median(seconds)), 1e3 * min(seconds), len(seconds))

    def plain(self) -> dict[str, float]:
        """Return the values, rounded to microseconds."""
        return {name: round(value, 3) for name, value in asdict(self).items()}


def timed(work: Callable[[], object], runs: int, warmups: int = 2) -> Timing:
    """Time an operation by the wall clock, after some warm-up runs."""
    for _ in range(warmups):
        work()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return Timing.of(seconds)


def set_up(isa: str, threads: int) -> None:
    """Set instruction set and threads for objects made from now on, and torch's threads."""
    _core.set_isa(isa)
    _core.set_threads(threads)
    torch.set_num_threads(threads)


class Works:
    """All operations of a frame on one scene, with the instruction set active at construction.

    World coordinates are those of the camera, so the pose is the identity. Each method runs one operation once.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.params = scene, scene.field.params
        self.view, self.color_depth = (CpuView(scene.camera, RENDER, variance=on) for on in (True, False))
        size = tuple(self.view.alpha.shape)
        self.raster = _core.Rasteriser()
        self.maps, self.ids = torch.zeros(9, *size), torch.zeros(2, *size, dtype=torch.int32)
        self.weights = torch.zeros(2, *size)
        self.target, self.later = (Target.of(f, (size[0], size[1])) for f in (scene.frame, scene.later))
        self.reference = self.target.depth.contiguous()
        self.numbers = view_params(scene.camera, np.eye(4), RENDER)
        self.grad = torch.zeros_like(self.params)
        chosen = preset(default_preset())
        self.tracking, self.mapping = chosen.tracking, chosen.mapping
        self.exposure = torch.zeros(2)
        self.image, self.live = (Pyramid.of(gray_of(f.color), f.depth_m, f.camera) for f in (scene.frame, scene.later))
        self.keyframe = keyframe_reference(self.params, self.view, self.image, np.eye(4), self.tracking)
        self.color = 0.9 * self.target.color
        self.cache = torch.zeros(_core.ssim_cache_floats(scene.camera.width, scene.camera.height))

    def forward_all(self) -> None:
        """Render all: colour, depth, σ² + c², moment about the sensor's depth, alpha, median and dominant splat."""
        maps, ids, weights = self.maps, self.ids, self.weights
        self.raster.view_forward(
            self.numbers, self.params, None, 7, RENDER.alpha_min, RENDER.transmittance_stop, RENDER.depth == "ray",
            self.reference, maps[:7], maps[7], maps[8], ids[0], weights[0], ids[1], weights[1],
            None, np.zeros(3),
        )  # fmt: skip

    def forward(self) -> None:
        """Render the maps a fit needs: colour, depth, σ² + c², alpha."""
        self.view.forward(self.params, np.eye(4))

    def forward_color_depth(self) -> None:
        """Render colour, depth and alpha only."""
        self.color_depth.forward(self.params, np.eye(4))

    def pose_only(self) -> None:
        """Compute the gradient of one step of tracking by Adam: forward, loss, backward to the pose only."""
        self.view.forward(self.params, np.eye(4))
        fits_of(self.view).tracking_loss(self.view, self.later, self.tracking, self.exposure)
        self.view.backward_pose(self.params)

    def backward(self) -> None:
        """Propagate the image gradients of the last loss to every parameter and the pose."""
        self.view.backward(self.params, self.grad)

    def mapping_iterations(self, count: int) -> list[float]:
        """Fit a copy of the field; return the seconds of each iteration, from one request of a keyframe to the next."""
        field, keyframe, starts = GaussianField(self.params.clone()), Keyframe(0, self.target, np.eye(4)), []

        def ticking() -> Iterator[list[Keyframe]]:
            for _ in range(count):
                starts.append(time.perf_counter())
                yield [keyframe]
            starts.append(time.perf_counter())

        fit_field(field, self.view, ticking(), self.mapping)
        return [end - start for start, end in pairwise(starts)]

    def ssim(self) -> None:
        """Compute SSIM and its gradient with the kernels, including the part of the target, as in each iteration."""
        c = self.scene.camera
        _core.ssim_target(self.target.color, self.target.depth, c.width, c.height, self.cache)
        _core.ssim(
            self.color, self.target.color, self.cache, c.width, c.height, self.target.depth, -0.2, self.view.g_sums[:3]
        )

    def ssim_torch(self) -> Tensor:
        """Compute SSIM and its gradient with the definition of the loss term in torch."""
        image = self.target.image.clone().requires_grad_()
        losses.ssim(image, self.target.image, self.target.depth_image > 0).backward()  # type: ignore[no-untyped-call]
        return image

    def pyramid(self) -> None:
        """Build the image pyramid of a live frame for tracking."""
        Pyramid.of(gray_of(self.scene.later.color), self.scene.later.depth_m, self.scene.camera)

    def keyframe_reference(self) -> None:
        """Make the reference of a keyframe for aligning later frames, including its render: once per keyframe."""
        keyframe_reference(self.params, self.view, self.image, np.eye(4), self.tracking)

    def track_align(self) -> None:
        """Track the later frame by Gauss–Newton on the keyframe's image, as for each frame; nothing is rendered."""
        fit_pose_align(self.keyframe, self.live, np.eye(4), self.tracking)

    def track_align_map(self) -> None:
        """Track the later frame by Gauss–Newton on the map rendered at the guess, including this render."""
        reference = map_reference(self.params, self.view, np.eye(4), self.tracking)
        fit_pose_align(reference, self.live, np.eye(4), self.tracking)

    def track_adam(self) -> None:
        """Track the later frame by 60 Adam iterations, as the papers do."""
        fit_pose_adam(self.params, self.view, self.later, np.eye(4), self.tracking, ADAM_ITERATIONS)

    def stages(self, runs: int) -> dict[str, float]:
        """Return the mean milliseconds of the stages inside forward and backward."""
        self.view.seconds[:] = 0.0
        for _ in range(runs):
            self.forward()
            self.backward()
        means = 1e3 * self.view.seconds[: len(STAGES)] / runs
        return dict(zip(STAGES, (round(float(ms), 3) for ms in means), strict=True))


ALWAYS = (
    "forward_all", "forward", "forward_color_depth", "pose_only", "backward", "ssim", "pyramid", "keyframe_reference",
    "track_align", "track_align_map",
)  # fmt: skip
"""Operations timed on every instruction set and number of threads, together with mapping_iteration."""
ONCE = ("ssim_torch", "track_adam")
"""Slow operations for comparison, timed only on the widest instruction set with all threads."""


def time_works(works: Works, runs: int, once: bool) -> dict[str, dict[str, float]]:
    """Time every operation; `once` adds those that are timed in one configuration only."""
    found = {name: timed(getattr(works, name), runs).plain() for name in (*ALWAYS, *(ONCE if once else ()))}
    # pose_only leaves its loss in the gradient planes, so backward propagates a real one; mapping writes its own.
    found["mapping_iteration"] = Timing.of(works.mapping_iterations(runs + 2)[2:]).plain()
    return found
