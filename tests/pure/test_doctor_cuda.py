"""What `doctor` reports about CUDA on machines where a part of it is missing."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from sigmasplat.errors import BackendError
from sigmasplat.fit import backends
from sigmasplat.plugins.checks import installation
from sigmasplat.plugins.cuda import cubins, launch as cuda_launch
from sigmasplat.registry import Backend
from sigmasplat.render import backend, reference
from sigmasplat.render.cpu import CpuView
from sigmasplat.render.view import View
from sigmasplat.types import Matrix


def cuda_findings() -> dict[str, installation.Finding]:
    return {finding.name: finding for finding in installation.check_cuda()}


def test_each_missing_part_has_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> str:
        raise BackendError("no NVRTC here")

    monkeypatch.setattr(cubins, "compiler_version", none)
    monkeypatch.setattr(cuda_launch, "missing", lambda: "torch finds no CUDA device")
    found = cuda_findings()
    assert found["NVRTC"].value == "missing: no NVRTC here"
    assert found["CUDA"].value == "not available: torch finds no CUDA device"
    assert all(finding.ok is None for finding in found.values()), "a machine without a GPU is healthy"


@pytest.mark.parametrize(("version", "enough"), [(13020, True), (12080, False)])
def test_a_driver_older_than_the_compiler_is_reported(
    monkeypatch: pytest.MonkeyPatch, version: int, enough: bool
) -> None:
    driver = pytest.importorskip("cuda.bindings.driver", reason="needs pip install 'sigmasplat[cuda]'")
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, version))
    monkeypatch.setattr(cubins, "compiler_version", lambda: "13.5")
    monkeypatch.setattr("torch.version.cuda", "13.0")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    found = cuda_launch.missing()
    assert (
        found is None
        if enough
        else f"for CUDA 12.8, too old for NVRTC 13.5; update it, or {cubins.INSTALL_OLDER}" in found
    )


def with_a_device(
    monkeypatch: pytest.MonkeyPatch, device: Callable[[], torch.device], view: Callable[..., View]
) -> None:
    """Let there be one device, whose backend makes these views."""
    row = Backend("cuda", lambda: reference, view, lambda: backends.CPU, device)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr(backend, "rows", lambda kind: [row])
    monkeypatch.setattr(backend, "automatic", backend.automatic.__wrapped__)


def test_auto_takes_a_device_whose_self_test_passes_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert backend.automatic() == ("cpu", ""), "no device, nothing to say"
    with_a_device(monkeypatch, lambda: torch.device("cuda", 0), CpuView)
    assert backend.backend_name("auto") == backend.backend_name("auto", torch.device("cpu")) == "cuda"
    assert backend.why_of("auto").startswith("computing on cuda:0, whose self-test passed")
    assert backend.backend_name("cpu") == "cpu" and not backend.why_of("cpu")


def test_auto_computes_on_the_cpu_where_the_self_test_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    class Wrong(CpuView):
        def backward(self, params: Tensor, g_params: Tensor, grad2d: Tensor | None = None) -> Matrix:
            twist = super().backward(params, g_params, grad2d)
            g_params[7] = torch.nan
            return twist

    with_a_device(monkeypatch, lambda: torch.device("cuda", 0), Wrong)
    assert backend.backend_name("auto") == "cpu"
    assert "the self-test of cuda:0 failed" in backend.why_of("auto") and "gradients inf" in backend.why_of("auto")


def test_auto_computes_on_the_cpu_where_the_device_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused() -> torch.device:
        raise BackendError("the CUDA backend cannot run: the driver is too old")

    with_a_device(monkeypatch, refused, CpuView)
    assert backend.automatic() == (
        "cpu",
        "computing on the CPU, because the CUDA backend cannot run: the driver is too old",
    )


def test_the_kernel_cache_is_below_xdg_cache_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert str(cubins.cache_folder()) == "/somewhere/sigmasplat/kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert str(cubins.cache_folder()).endswith("/.cache/sigmasplat/kernels")


def test_tensors_on_another_device_are_refused() -> None:
    with pytest.raises(BackendError, match="takes tensors on a CUDA device; these are on cpu"):
        cuda_launch.launcher_for(torch.device("cpu"))


@pytest.mark.skipif(cuda_launch.missing() is None, reason="there is a CUDA device")
def test_asking_for_cuda_without_a_device_is_refused_in_one_line() -> None:
    import numpy as np

    from sigmasplat.config import RenderConfig
    from sigmasplat.data.camera import Camera
    from sigmasplat.data.field import GaussianField
    from sigmasplat.render import render
    from sigmasplat.render.backend import make_view

    camera = Camera(8, 6, 7.0, 7.0, 3.5, 2.5)
    for ask in (
        lambda: make_view("cuda", camera, RenderConfig()),
        lambda: render(GaussianField.empty(), camera, np.eye(4), backend="cuda"),
    ):
        with pytest.raises(BackendError, match="the CUDA backend cannot run: ") as refused:
            ask()
        assert "\n" not in str(refused.value)
