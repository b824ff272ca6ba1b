"""Check the installation for `sigmasplat doctor`: versions, processor, kernels, CUDA, and a rendering self-test."""

import os
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module, metadata
from typing import Any

from sigmasplat.api import BackendError, env, machine

MAX_DIFFERENCE = 1e-2
"""If rounding moves a splat across the threshold alpha_min, a pixel can change by up to 1/255."""
MEAN_DIFFERENCE = 1e-4


@dataclass(frozen=True)
class Finding:
    """One line of the output. `ok` is the result of a test, or None for plain information."""

    name: str
    value: str
    ok: bool | None = None


def check_installation() -> Iterator[Finding]:
    """Yield the findings: information first, then the tests."""
    versions = ", ".join(f"{name} {_version(name)}" for name in ("torch", "numpy", "scipy"))
    switches = env.switches()
    yield Finding("sigmasplat", f"{machine.package_version()} on Python {platform.python_version()}")
    yield Finding("libraries", versions)
    yield Finding("processor", f"{machine.cpu_model()}, {machine.usable_cores()} cores usable")
    yield Finding("switches", f"threads={switches.threads or 'all'} isa={switches.isa} backend={switches.backend}")
    yield Finding("OMP_WAIT_POLICY", os.environ.get("OMP_WAIT_POLICY", "unset"))
    native = check_kernels()
    yield native
    if native.ok:
        yield self_test()
    yield from check_cuda()


def verdict(findings: list[Finding]) -> tuple[bool, str]:
    """Return whether all tests passed, and a sentence with the result."""
    failed = [finding.name for finding in findings if finding.ok is False]
    if failed:
        return False, f"not healthy: {', '.join(failed)} failed; reinstall with `make demo`, or report this output"
    return True, "healthy: the compiled kernels agree with the reference renderer"


def check_kernels() -> Finding:
    """Load the compiled kernels. Report the instruction set in use, and those that this processor supports."""
    try:
        core: Any = import_module("sigmasplat.render.cpu") and import_module("sigmasplat.native._core")
    except (BackendError, ImportError) as problem:
        reason = problem.__cause__ or problem
        return Finding("kernels", f"cannot be loaded ({reason}); {_remedy(reason)}", False)
    offered = ", ".join(core.supported_isas())
    return Finding("kernels", f"{core.isa_name()} (processor supports {offered}), {core.threads()} threads", True)


def _remedy(problem: BaseException) -> str:
    if getattr(problem, "name", None) == "torch":
        return "pip install torch"
    if "libgomp" in str(problem):  # some builds of torch include it under another name
        return "sudo apt install libgomp1"
    return "install a wheel, or the sources with pip install ."


def check_cuda() -> Iterator[Finding]:
    """Check NVRTC, driver and GPUs, one line each, and run the self-test on each GPU.

    Missing parts are not faults: a machine without a GPU is healthy.
    """
    import torch

    from sigmasplat.plugins.cuda import cubins, launch as cuda_launch

    try:
        compiler = cubins.compiler_version()
        cached = len(list(cubins.cache_folder().glob("*.cubin")))
        yield Finding("NVRTC", f"{compiler}, {cached} compiled programs in {cubins.cache_folder()}")
    except BackendError as problem:
        yield Finding("NVRTC", f"missing: {problem}")
    missing = cuda_launch.missing()
    if missing:
        yield Finding("CUDA", f"not available: {missing}")
        return
    yield check_driver(cubins.compiler_version())
    for index in range(torch.cuda.device_count()):
        device = torch.device("cuda", index)
        about = torch.cuda.get_device_properties(device)
        architecture = cubins.architecture_of((about.major, about.minor))
        yield Finding(str(device), f"{about.name}, {architecture}, {about.total_memory / 2**30:.0f} GiB")
        try:
            yield self_test(device)
        except BackendError as problem:
            yield Finding("self-test", str(problem), False)


def check_driver(compiler: str) -> Finding:
    """Compare the versions of driver and compiler: the driver must have the same major version, or a newer one."""
    from cuda.bindings import driver

    from sigmasplat.plugins.cuda import cubins

    version = driver.cuDriverGetVersion()[1]
    enough = version // 1000 >= int(compiler.split(".")[0])
    advice = "" if enough else f"; too old for NVRTC {compiler}: update it, or {cubins.INSTALL_OLDER}"
    return Finding("CUDA driver", f"for CUDA {version // 1000}.{version % 1000 // 10}{advice}", enough)


def self_test(device: Any = "cpu") -> Finding:
    """Render 300 splats with the kernels of a device and with the reference renderer, and compare the images."""
    import torch

    from sigmasplat.api import backend_module, reference

    started_s = time.perf_counter()
    name = "cpu" if str(device) == "cpu" else "cuda"
    with torch.no_grad():
        ours, expected = _picture(backend_module(name), device).cpu(), _picture(reference)
    difference = (ours - expected).abs()
    largest, mean = float(difference.max()), float(difference.mean())
    ok = bool(torch.isfinite(ours).all()) and largest < MAX_DIFFERENCE and mean < MEAN_DIFFERENCE
    seconds = time.perf_counter() - started_s
    return Finding("self-test", f"largest difference {largest:.1e}, mean {mean:.1e} ({seconds:.2f} s)", ok)


def _picture(backend: Any, device: Any = "cpu") -> Any:
    """Render a fixed random cloud of splats: colour and alpha, [H, W, 4]."""
    import torch

    from sigmasplat.api import Camera, RenderConfig

    random = torch.Generator().manual_seed(0)
    means, shapes, quats, colors = (torch.rand(300, n, generator=random).to(device) for n in (3, 3, 4, 3))
    camera, options = Camera(64, 48, 60.0, 60.0, 31.5, 23.5), RenderConfig(depth="center")
    means = (means - 0.5) * means.new_tensor([3.0, 2.0, 2.0]) + means.new_tensor([0.0, 0.0, 2.0])
    seen = backend.project(means, quats - 0.5, 0.01 + 0.1 * shapes, torch.eye(4), camera, options)
    blended = backend.blend(*seen[:4], 0.2 + 0.7 * colors[:, 0], colors, None, camera, options)
    return torch.cat([blended.sums, blended.alpha[..., None]], -1)


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"
