"""What doctor says of CUDA on machines that lack one thing or another."""

import pytest

from sigmasplat.checks import installation
from sigmasplat.errors import BackendError
from sigmasplat.native.cuda import cubins
from sigmasplat.render.cuda import launch as cuda_launch


def said() -> dict[str, installation.Finding]:
    return {finding.name: finding for finding in installation.cuda()}


def test_each_thing_that_is_missing_has_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> str:
        raise BackendError("no NVRTC here")

    monkeypatch.setattr(cubins, "compiler_version", none)
    monkeypatch.setattr(cuda_launch, "missing", lambda: "torch finds no CUDA device")
    found = said()
    assert found["NVRTC"].value == "missing: no NVRTC here"
    assert found["CUDA"].value == "not available: torch finds no CUDA device"
    assert all(finding.ok is None for finding in found.values()), "a machine without a GPU is healthy"


@pytest.mark.parametrize(("version", "enough"), [(13020, True), (12080, False)])
def test_a_driver_older_than_the_compiler_is_reported(
    monkeypatch: pytest.MonkeyPatch, version: int, enough: bool
) -> None:
    driver = pytest.importorskip("cuda.bindings.driver", reason="needs pip install 'sigmasplat[gpu]'")
    monkeypatch.setattr(driver, "cuDriverGetVersion", lambda: (0, version))
    monkeypatch.setattr(cubins, "compiler_version", lambda: "13.5")
    monkeypatch.setattr(cuda_launch, "missing", lambda: "")
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    finding = said()["CUDA driver"]
    assert finding.ok is enough and (cubins.INSTALL_OLDER in finding.value) is not enough


def test_the_cache_follows_the_users_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert str(cubins.cache_folder()) == "/somewhere/sigmasplat/kernels"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert str(cubins.cache_folder()).endswith("/.cache/sigmasplat/kernels")


def test_tensors_elsewhere_are_refused() -> None:
    import torch

    with pytest.raises(BackendError, match="takes tensors on a CUDA device; these are on cpu"):
        cuda_launch.launcher_for(torch.device("cpu"))


@pytest.mark.skipif(cuda_launch.missing() is None, reason="there is a CUDA device")
def test_asking_for_cuda_without_a_device_is_refused_in_one_line() -> None:
    import numpy as np

    from sigmasplat.config import RenderConfig
    from sigmasplat.model.camera import Camera
    from sigmasplat.model.field import GaussianField
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
