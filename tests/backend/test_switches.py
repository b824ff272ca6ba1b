"""What the environment asks for is what computes; a setting of the run is stronger."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from sigmasplat import env
from sigmasplat.errors import BackendError
from sigmasplat.render import reference
from sigmasplat.render.backend import backend_module, make_view
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.reference import ReferenceView
from splat_fields import OPTIONS
from splat_scenes import SMALL

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

from sigmasplat.native import _core
from sigmasplat.render import cpu

SHOW = """
import sigmasplat.render.cpu
from sigmasplat.native import _core
print(_core.isa_name(), _core.threads())
"""


def shown(**environment: str) -> str:
    """Ask a new process which kernels it runs, on how many threads."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("SIGMASPLAT_")}
    answer = subprocess.run(
        [sys.executable, "-c", SHOW], env=inherited | environment, capture_output=True, text=True, timeout=60
    )
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.strip()


def test_the_environment_chooses_instruction_set_and_threads() -> None:
    assert shown(SIGMASPLAT_ISA="baseline", SIGMASPLAT_THREADS="3") == "baseline 3"
    assert shown(OMP_NUM_THREADS="2") == f"{_core.supported_isas()[0]} 2"


def test_an_instruction_set_this_machine_has_not_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu, "_core", SimpleNamespace(supported_isas=lambda: ["avx2", "baseline"]))
    with pytest.raises(BackendError, match=r"SIGMASPLAT_ISA is 'avx512', which .* or give avx2, baseline"):
        cpu.apply_switches(env.Switches(isa="avx512"))


@pytest.mark.parametrize(
    ("switch", "asked", "expected"),
    [
        ("auto", "auto", "cpu"), ("cpu", "auto", "cpu"), ("reference", "auto", "reference"),
        ("reference", "cpu", "cpu"), ("cpu", "reference", "reference"),
    ],
)  # fmt: skip
def test_the_environment_chooses_the_renderer_where_the_settings_say_auto(
    monkeypatch: pytest.MonkeyPatch, switch: str, asked: str, expected: str
) -> None:
    monkeypatch.setattr(env, "switches", lambda: env.Switches(backend=switch))
    wanted = {"cpu": (cpu, CpuView), "reference": (reference, ReferenceView)}[expected]
    assert backend_module(asked) is wanted[0]
    assert type(make_view(asked, SMALL, OPTIONS)) is wanted[1]


def test_an_unknown_renderer_is_refused() -> None:
    for make in (backend_module, lambda name: make_view(name, SMALL, OPTIONS)):
        with pytest.raises(BackendError, match="unknown backend 'cuda9'"):
            make("cuda9")
