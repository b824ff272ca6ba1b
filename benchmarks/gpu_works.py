"""Define the operations that the GPU benchmark times, each as the product runs it, and time them on a device."""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from scenes import Scene, make_scene
from torch import Tensor
from works import RENDER, Timing

from sigmasplat.config import TrackingConfig
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.errors import BackendError
from sigmasplat.fit.field import fit_field
from sigmasplat.fit.pose import fit_pose_adam, fit_pose_align
from sigmasplat.fit.references import keyframe_reference, live_image
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.view import CudaView

FRAME = 100
WARMUPS, ITERATIONS, TRACKING_ITERATIONS = 3, 10, 60
"""Numbers of iterations of the timed fits; the time of one iteration is reported."""


def refuse_without_device() -> None:
    """Raise BackendError, one line, if the CUDA backend cannot run."""
    reason = cuda_launch.missing()
    if reason:
        raise BackendError(f"nothing to time: {reason}")


def describe_device() -> dict[str, Any]:
    """Return the device's name, capability, memory and driver, and torch's version."""
    about = torch.cuda.get_device_properties(0)
    memory_gib = round(about.total_memory / 2**30, 1)
    return {
        "name": about.name,
        "capability": [about.major, about.minor],
        "memory_gib": memory_gib,
        "driver": _driver(),
        "torch": torch.__version__,
    }


def _driver() -> str | None:
    """Return the version of NVIDIA's driver; None if nvidia-smi does not say it."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader", "--id=0"]
    try:
        return subprocess.run(query, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def timed(work: Callable[[], object], runs: int, device: torch.device) -> Timing:
    """Time an operation by the wall clock until the device has finished, after some warm-up runs."""
    seconds = []
    for run in range(WARMUPS + runs):
        _wait(device)
        start = time.perf_counter()
        work()
        _wait(device)
        if run >= WARMUPS:
            seconds.append(time.perf_counter() - start)
    return Timing.of(seconds)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class Launched(TrackingConfig):
    """Settings with which each kernel is launched on its own."""

    cuda_graphs: ClassVar[bool] = False


class GpuWorks:
    """All operations of a frame on one scene, in the coordinates of its camera. Each method runs one operation once."""

    def __init__(self, scene: Scene, device: torch.device) -> None:
        self.scene, self.device = scene, device
        self.field = scene.field.copy_to(device)
        self.params, self.grad = self.field.params, torch.zeros_like(self.field.params)
        self.all, self.color_depth = (CudaView(scene.camera, RENDER, on, device) for on in (True, False))
        size = (scene.camera.height, scene.camera.width)
        self.target, self.later = (Target.of(frame, size).to(device) for frame in (scene.frame, scene.later))
        for view in (self.all, self.color_depth):
            for plane in (view.g_sums, view.g_alpha, view.g_moment):
                plane.fill_(1e-3)
        chosen = preset(default_preset())
        self.mapping, self.aligning = chosen.mapping, chosen.tracking
        self.tracking = TrackingConfig(method="adam")
        image, self.live = (
            live_image(self.all, frame.color, frame.depth_m, target)
            for frame, target in ((scene.frame, self.target), (scene.later, self.later))
        )
        self.keyframe = keyframe_reference(self.params, self.all, image, np.eye(4), self.aligning)

    def forward_all(self) -> None:
        """Render all: colour, depth, σ² + c², moment about the sensor's depth, alpha, median and dominant splat."""
        self.all.forward(self.params, np.eye(4), self.target.depth, layers=True)

    def forward_color_depth(self) -> None:
        """Render colour, depth and alpha only."""
        self.color_depth.forward(self.params, np.eye(4))

    def both_all(self) -> None:
        """Render all outputs, and propagate gradients of all of them to every parameter and the pose."""
        self.forward_all()
        self.all.backward(self.params, self.grad)

    def both_color_depth(self) -> None:
        """Render colour, depth and alpha only, and propagate their gradients to every parameter and the pose."""
        self.forward_color_depth()
        self.color_depth.backward(self.params, self.grad)

    def both_pose(self) -> None:
        """Render colour and depth, and propagate their gradients to the pose only."""
        self.forward_color_depth()
        self.color_depth.backward_pose(self.params)

    def align(self) -> None:
        """Track the later frame by Gauss–Newton on the keyframe's image, as the default preset does."""
        fit_pose_align(self.keyframe, self.live, np.eye(4), self.aligning)

    def mapping_iterations(self) -> None:
        """Fit the field to one keyframe for `ITERATIONS`."""
        fit_field(self.field, self.all, [[Keyframe(0, self.target, np.eye(4))]] * ITERATIONS, self.mapping)

    def tracking_iterations(self) -> None:
        """Descend the tracking loss for `TRACKING_ITERATIONS`, captured as a CUDA graph."""
        fit_pose_adam(self.params, self.all, self.later, np.eye(4), self.tracking, TRACKING_ITERATIONS)

    def launched_tracking_iterations(self) -> None:
        """Descend the tracking loss for `TRACKING_ITERATIONS`, without a CUDA graph."""
        launched = Launched(method="adam")
        fit_pose_adam(self.params, self.all, self.later, np.eye(4), launched, TRACKING_ITERATIONS)


SINGLE = ("forward_all", "forward_color_depth", "both_all", "both_color_depth", "both_pose", "align")
MANY = ("tracking_iterations", "launched_tracking_iterations", "mapping_iterations")


def steps_of(name: str) -> int:
    """Return how many iterations an operation takes."""
    return 1 if name in SINGLE else ITERATIONS if name == "mapping_iterations" else TRACKING_ITERATIONS


def measure(width: int, height: int, splats: int, runs: int, seed: int, with_peer: bool = True) -> dict[str, Any]:
    """Time all operations on one scene, and optionally gsplat on the same splats."""
    device = torch.device("cuda", torch.cuda.current_device())
    scene = make_scene(f"synthetic:frames=200,width={width},height={height}", FRAME, splats, width, seed)
    torch.cuda.reset_peak_memory_stats(device)
    peer = time_gsplat(scene, runs, device) if with_peer else None
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    return {
        "splats": splats, "width": width, "height": height, "works": time_works(GpuWorks(scene, device), runs),
        "peak_mib": round(torch.cuda.max_memory_allocated(device) / 2**20, 1), "gsplat": peer,
    }  # fmt: skip


def time_works(works: GpuWorks, runs: int) -> dict[str, dict[str, float]]:
    """Time every operation; for fits, one iteration."""
    found = {name: timed(getattr(works, name), runs, works.device).plain() for name in SINGLE}
    for name in MANY:
        taken, steps = timed(getattr(works, name), max(runs // ITERATIONS, 1), works.device), steps_of(name)
        found[name[:-1]] = Timing(taken.median_ms / steps, taken.min_ms / steps, taken.runs).plain()
    return found


def time_gsplat(scene: Scene, runs: int, device: torch.device) -> dict[str, Any] | None:
    """Time gsplat's colour and depth on the same splats and camera, packed or not, whichever is faster; None if it is
    not installed or does not run."""
    if importlib.util.find_spec("gsplat") is None:
        return None
    try:
        return _time_gsplat(scene, runs, device)
    except Exception as problem:  # the kernels are compiled at first use, which can fail in many ways
        print(f"gsplat is left out: {problem!r}"[:500], file=sys.stderr, flush=True)
        return None


def _time_gsplat(scene: Scene, runs: int, device: torch.device) -> dict[str, Any]:
    import gsplat

    f, c = scene.field.copy_to(device), scene.camera
    leaves = [x.detach().clone().requires_grad_() for x in (f.means, f.quats, f.scales, f.opacities, f.colors)]
    K = torch.tensor([[[c.fx, 0.0, c.cx + 0.5], [0.0, c.fy, c.cy + 0.5], [0.0, 0.0, 1.0]]], device=device)
    at = torch.eye(4, device=device)[None]

    def forward(packed: bool) -> tuple[Tensor, Tensor]:
        image, alpha, _ = gsplat.rasterization(
            *leaves, at, K, c.width, c.height, near_plane=RENDER.near_m, eps2d=RENDER.low_pass_px2,
            render_mode="RGB+D", packed=packed,
        )  # fmt: skip
        return image, alpha

    def both(packed: bool) -> None:
        image, alpha = forward(packed)
        torch.autograd.grad(1e-3 * (image.sum() + alpha.sum()), leaves)

    def fastest(work: Callable[[bool], object]) -> dict[str, Any]:
        """Time the packed and the unpacked form, and return the faster one."""
        times = [timed(partial(work, packed), runs, device).plain() | {"packed": packed} for packed in (True, False)]
        return min(times, key=lambda time: float(time["median_ms"]))

    with torch.no_grad():
        forward_ms = fastest(forward)
        image = forward(True)[0][0, ..., :3]
    ours = CudaView(c, RENDER, False, device)
    ours.forward(f.params, np.eye(4))
    difference = float((ours.sums[:3].movedim(0, -1) - image).abs().mean())
    return {
        "version": gsplat.__version__, "forward": forward_ms, "both": fastest(both),
        "mean_color_difference": difference,
    }  # fmt: skip
