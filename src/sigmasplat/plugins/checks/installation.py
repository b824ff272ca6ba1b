"""Check the installation for `sigmasplat doctor`: versions, processor, kernels, CUDA, and a rendering self-test."""

import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module, metadata
from typing import Any

from sigmasplat.api import BackendError, automatic, env, kernel_speed, machine, make_view, self_test


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
        yield from check_backend("cpu")
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
        cached = len(list(cubins.cache_folder().glob("*.cubin")))
        yield Finding("NVRTC", f"{cubins.compiler_version()}, {cached} compiled programs in {cubins.cache_folder()}")
    except BackendError as problem:
        yield Finding("NVRTC", f"missing: {problem}")
    if missing := cuda_launch.missing():
        yield Finding("CUDA", f"not available: {missing}")
        return
    for index in range(torch.cuda.device_count()):
        device = torch.device("cuda", index)
        about = torch.cuda.get_device_properties(device)
        architecture = cubins.architecture_of((about.major, about.minor))
        yield Finding(str(device), f"{about.name}, {architecture}, {about.total_memory / 2**30:.0f} GiB")
        with torch.cuda.device(device):
            yield from check_backend("cuda")
    yield Finding("backend auto", automatic().why)


def check_backend(name: str) -> Iterator[Finding]:
    """Compare a backend with the definition in plain torch, and measure it."""
    try:
        found = self_test(make := partial(make_view, name))
        yield Finding("self-test", str(found), found.ok)
        yield Finding("speed", kernel_speed(make))
    except BackendError as problem:
        yield Finding("self-test", str(problem), False)


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"
