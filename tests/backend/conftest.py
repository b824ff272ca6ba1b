"""Give every backend test the same two operators, `.project` and `.blend`, with the reference's signatures."""

import importlib
from collections.abc import Callable
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
