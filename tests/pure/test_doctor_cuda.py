"""What `doctor` reports about CUDA on machines where a part of it is missing."""

import pytest

from sigmasplat.errors import BackendError
from sigmasplat.plugins.checks import installation
from sigmasplat.plugins.cuda import cubins, launch as cuda_launch


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
    driver = pytest.importorskip("cuda.bindings.driver", reason="needs pip install 'sigmasplat[gpu]'")
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, version))
    finding = installation.check_driver("13.5")
    assert finding.ok is enough and (cubins.INSTALL_OLDER in finding.value) is not enough


def test_the_kernel_cache_is_below_xdg_cache_home(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert str(cubins.cache_folder()) == "/somewhere/sigmasplat/kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert str(cubins.cache_folder()).endswith("/.cache/sigmasplat/kernels")


def test_tensors_on_another_device_are_refused() -> None:
    import torch

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
