"""Give every backend test the same two operators, `.project` and `.blend`, with the reference's signatures."""

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest

MODULES = {"reference": "sigmasplat.render.reference", "cpu": "sigmasplat.render.cpu"}


@dataclass(frozen=True)
class Backend:
    """One implementation of the kernel seam."""

    name: str
    project: Callable[..., Any]
    blend: Callable[..., Any]


@pytest.fixture(scope="session", params=list(MODULES))
def backend(request: pytest.FixtureRequest) -> Backend:
    """Load a backend; the compiled one is skipped only where its extension module is not built."""
    if request.param == "cpu":
        pytest.importorskip(
            "sigmasplat.native._core", reason="sigmasplat.native._core is not built (make test builds it)"
        )
    module = importlib.import_module(MODULES[request.param])
    return Backend(request.param, module.project, module.blend)


@pytest.fixture(params=["avx512", "avx2", "baseline"])
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the kernels of one instruction set; skipped where this processor has it not."""
    core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    if request.param not in core.supported_isas():
        pytest.skip(f"this processor does not run {request.param}")
    before = core.isa_name()
    core.set_isa(request.param)
    yield request.param
    core.set_isa(before)


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """Choose how many threads the kernels use, for one test."""
    core = pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
    before = core.threads()
    yield core.set_threads
    core.set_threads(before)
