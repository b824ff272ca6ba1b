"""Measure one scene, or compare with plain torch, in a separate process: cold caches, its own peak memory."""

import importlib
import resource
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scenes import Scene, count_pairs, make_scene
from works import RENDER, Works, set_up, time_works, timed

from sigmasplat.native import _core
from sigmasplat.render import render
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView

PAIR_PIXELS = 400
REFERENCE_WIDTH, REFERENCE_BACKWARD_SHARE = 80, 10
"""Plain torch stores every (pixel, splat) pair for its backward pass, which therefore gets a tenth of the splats."""


@dataclass(frozen=True)
class Request:
    """What to measure: frame `index` of a sequence back-projected to `splats`, `width` pixels wide."""

    path: str
    index: int
    splats: int
    width: int
    runs: int
    isas: tuple[str, ...]
    threads: tuple[int, ...]
    seed: int
    peer: str | None = None


def peak_mib() -> float:
    """Return the peak memory of this process so far, MiB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def measure(request: Request) -> dict[str, Any]:
    """Time all operations on every instruction set and number of threads; the first set with all threads is main."""
    scene = make_scene(request.path, request.index, request.splats, request.width, request.seed)
    before = peak_mib()
    main = (request.isas[0], max(request.threads))
    set_up(*main)
    works = Works(scene)
    timings = [_entry(*main, time_works(works, request.runs, once=False))]
    memory = {"before_mib": before, "peak_mib": peak_mib()}
    stages = works.stages(request.runs)
    timings[0]["works"] |= time_works(works, request.runs, once=True)
    for isa in request.isas:
        for threads in sorted(request.threads, reverse=True):
            if (isa, threads) != main:
                set_up(isa, threads)
                timings.append(_entry(isa, threads, time_works(Works(scene), request.runs, once=False)))
    set_up(*main)
    pairs, error = count_pairs(scene.field, scene.camera, RENDER, PAIR_PIXELS, np.random.default_rng(request.seed))
    return {
        "splats": request.splats,
        "width": scene.camera.width,
        "height": scene.camera.height,
        "frames": scene.frames,
        "pairs": round(pairs),
        "pairs_standard_error": round(error),
        "pairs_sampled_pixels": PAIR_PIXELS,
        "memory": memory,
        "stages_ms": stages,
        "timings": timings,
        "peer": time_peer(request.peer, scene, request.runs) if request.peer else None,
    }


def _entry(isa: str, threads: int, works: dict[str, dict[str, float]]) -> dict[str, Any]:
    return {"isa": isa, "threads": threads, "works": works}


def load_peer(name: str) -> Callable[..., Any]:
    """Return the function named "module:function". Raises ValueError, ImportError or AttributeError."""
    module, colon, function = name.partition(":")
    if not (module and colon and function):
        raise ValueError(f"a peer must be given as module:function, found {name!r}")
    found: Callable[..., Any] = getattr(importlib.import_module(module), function)
    return found


def time_peer(name: str, scene: Scene, runs: int) -> dict[str, Any]:
    """Time another rasteriser on the same splats, and measure the difference of its image to ours.

    It is called as function(means [N, 3], quats [N, 4] wxyz, scales [N, 3], opacities [N], colors [N, 3], K [3, 3],
    T_camera_world [4, 4], width, height) with float32 tensors, and returns an image [H, W, 3].
    """
    function, field, c = load_peer(name), scene.field, scene.camera
    K = torch.tensor([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]], dtype=torch.float32)
    columns = (field.means, field.quats, field.scales, field.opacities, field.colors)
    arguments = [column.detach().contiguous() for column in columns] + [K, torch.eye(4)]
    with torch.no_grad():
        timing = timed(lambda: function(*arguments, c.width, c.height), runs, warmups=1)
        image = np.asarray(function(*arguments, c.width, c.height), np.float32)
        ours = render(field, c, np.eye(4), options=RENDER, backend="cpu").color.numpy()
    difference = float(np.abs(image - ours).mean()) if image.shape == ours.shape else None
    return {"name": name, "forward": timing.plain(), "mean_color_difference": difference}


def compare_reference(request: Request, splats: int) -> dict[str, Any]:
    """Time plain torch and the kernels on the same small input: forward, and forward with the full backward pass."""
    set_up(request.isas[0], max(request.threads))
    whole = make_scene(request.path, request.index, splats, REFERENCE_WIDTH, request.seed)
    part = make_scene(request.path, request.index, splats // REFERENCE_BACKWARD_SHARE, REFERENCE_WIDTH, request.seed)
    compared = []
    for name, scene, backward, runs in (("forward", whole, False, 3), ("forward + backward", part, True, 3)):
        kernels = timed(_passes(CpuView(scene.camera, RENDER), scene, backward), request.runs)
        with torch.set_grad_enabled(backward):
            plain = timed(_passes(ReferenceView(scene.camera, RENDER), scene, backward), runs, warmups=1)
        size = {"splats": len(scene.field), "width": scene.camera.width, "height": scene.camera.height}
        compared.append({"work": name, **size, "kernels": kernels.plain(), "torch": plain.plain()})
    return {"isa": _core.isa_name(), "threads": max(request.threads), "compared": compared}


def _passes(view: CpuView | ReferenceView, scene: Scene, backward: bool) -> Callable[[], None]:
    """Return one pass over a view: forward, and optionally backward with every gradient 1."""
    params, grad = scene.field.params, torch.zeros_like(scene.field.params)
    view.g_sums.fill_(1.0)
    view.g_alpha.fill_(1.0)

    def once() -> None:
        view.forward(params, np.eye(4))
        if backward:
            view.backward(params, grad)

    return once
