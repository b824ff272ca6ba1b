"""Give every backend test the same two operators, `.project` and `.blend`, with the reference's signatures."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import torch

from emulated_cuda import Emulator, rubbish, why_not
from sigmasplat.errors import BackendError
from sigmasplat.plugins.cuda import launch as cuda_launch
from sigmasplat.plugins.cuda.raster import Raster
from sigmasplat.render import Render, render
from stand_in import StandIn, library_in, standing_in

LIBRARY = pytest.StashKey[Any]()


def pytest_collection_finish(session: pytest.Session) -> None:
    """Load what the stand-in device needs before any test differentiates: autograd looks for devices once."""
    wanted = any({"stand_in", "device"} & set(getattr(item, "fixturenames", ())) for item in session.items)
    if wanted and why_not() is None and torch.version.cuda is None:
        with TemporaryDirectory() as folder:
            session.config.stash[LIBRARY] = library_in(Path(os.environ.get("REHEARSAL", folder)))


@dataclass(frozen=True)
class Backend:
    """One implementation of the kernel seam."""

    name: str
    project: Callable[..., Any]
    blend: Callable[..., Any]
    render: Callable[..., Any]
    """Of a whole field, as `sigmasplat.render.render`; the maps come back to the CPU."""


@pytest.fixture(scope="session")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> Emulator:
    """Run the CUDA kernels' text on the CPU; each program is compiled once, when it is first needed."""
    reason = why_not()
    if reason:
        pytest.skip(reason)
    if "REHEARSAL" in os.environ:  # of benchmarks/flight.sh, whose processes compile each program once
        return Emulator(Path(os.environ["REHEARSAL"]))
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # the folder of a worker is in that of the session
        shared = shared.parent
    (shared / "emulated").mkdir(exist_ok=True)
    return Emulator(shared / "emulated")


@pytest.fixture
def on_the_cpu(emulator: Emulator) -> Iterator[Emulator]:
    """Let views of the CUDA backend run in the emulation, threads in their order; what nobody wrote is not zero."""
    with emulator.standing_in(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(Raster, "empty", rubbish)
        emulator.order = 0
        yield emulator
        emulator.order = 0


@pytest.fixture
def stand_in(request: pytest.FixtureRequest, emulator: Emulator) -> Iterator[StandIn]:
    """Let there be a CUDA device that is none (stand_in.py), where torch knows of no true one."""
    if LIBRARY not in request.config.stash:
        pytest.skip("this torch is built with CUDA: tests of a device run on a true one")
    with standing_in(emulator, request.config.stash[LIBRARY]) as device:
        yield device


@pytest.fixture
def device(request: pytest.FixtureRequest) -> torch.device:
    """Return a CUDA device, the stand-in where torch is built without CUDA."""
    if torch.version.cuda is None:
        request.getfixturevalue("stand_in")
        return torch.device("cuda", 0)
    try:
        return cuda_launch.this_device()
    except BackendError as problem:
        pytest.skip(str(problem))


@pytest.fixture(scope="session", params=["reference", "cpu", "emulated", "cuda"])
def backend(request: pytest.FixtureRequest) -> Backend:
    """Load a backend: the definition, the CPU's kernels, the CUDA kernels emulated on the CPU and on a device."""
    return MAKERS[request.param](request)


def _reference(request: pytest.FixtureRequest) -> Backend:
    from sigmasplat.render import reference

    return Backend("reference", reference.project, reference.blend, partial(render, backend="reference"))


def _cpu(request: pytest.FixtureRequest) -> Backend:
    pytest.importorskip("sigmasplat.native._core", reason="sigmasplat.native._core is not built (make test builds it)")
    from sigmasplat.render import cpu

    return Backend("cpu", cpu.project, cpu.blend, partial(render, backend="cpu"))


def _emulated(request: pytest.FixtureRequest) -> Backend:
    from sigmasplat.plugins.cuda import operators as cuda

    emulator: Emulator = request.getfixturevalue("emulator")

    def stand_in(operator: Callable[..., Any]) -> Callable[..., Any]:
        def run(*inputs: Any, **named: Any) -> Any:
            with emulator.standing_in():
                return operator(*inputs, **named)

        return run

    whole = partial(render, backend="cuda")
    return Backend("emulated", stand_in(cuda.project), stand_in(cuda.blend), stand_in(whole))


def _cuda(request: pytest.FixtureRequest) -> Backend:
    from sigmasplat.plugins.cuda import operators as cuda

    reason = cuda_launch.missing()
    if reason:
        pytest.skip(reason)

    def on_device(operator: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(operator)
        def run(*inputs: Any) -> Any:
            there = [x.cuda() if isinstance(x, torch.Tensor) else x for x in inputs]
            found = operator(*there)
            return type(found)(*(x if x is None else x.cpu() for x in found))

        return run

    def whole(*inputs: Any, **named: Any) -> Render:
        maps = vars(render(*inputs, **named, backend="cuda"))
        return Render(**{name: None if plane is None else plane.cpu() for name, plane in maps.items()})

    return Backend("cuda", on_device(cuda.project), on_device(cuda.blend), whole)


MAKERS = {"reference": _reference, "cpu": _cpu, "emulated": _emulated, "cuda": _cuda}


@pytest.fixture(params=["cpu", "cuda"])
def kernels(request: pytest.FixtureRequest) -> str:
    """Name kernels that views and steps run on: the CPU's, and CUDA's emulated on the CPU."""
    if request.param == "cuda":
        request.getfixturevalue("on_the_cpu")
    else:
        pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    return str(request.param)


@pytest.fixture(params=["avx512", "avx2", "baseline", "cuda"])
def every_kernels(request: pytest.FixtureRequest) -> Iterator[str]:
    """Do the same, with the CPU's kernels of each instruction set in turn."""
    if request.param == "cuda":
        request.getfixturevalue("on_the_cpu")
        yield "cuda"
        return
    with instruction_set(request.param):
        yield "cpu"


@pytest.fixture(params=["avx512", "avx2", "baseline"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the kernels of one instruction set; skipped where the processor does not support it."""
    with instruction_set(request.param):
        yield request.param


@contextmanager
def instruction_set(name: str) -> Iterator[None]:
    core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    if name not in core.supported_isas():
        pytest.skip(f"this processor does not run {name}")
    before = core.isa_name()
    core.set_isa(name)
    yield
    core.set_isa(before)


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """Choose how many threads the kernels use, for one test."""
    core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    before = core.threads()
    yield core.set_threads
    core.set_threads(before)
