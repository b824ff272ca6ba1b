"""Run the GPU benchmark's pieces of work on the emulation, lay out its figures, and see it refuse without a device."""

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from emulated_cuda import Emulator
from sigmasplat.errors import BackendError
from sigmasplat.plugins.cuda import launch as cuda_launch

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))
gpu, gpu_works, record, scenes, tables = map(
    importlib.import_module, ("gpu", "gpu_works", "record", "scenes", "tables")
)


@pytest.fixture
def works(emulator: Emulator) -> Any:
    with emulator.standing_in():
        emulator.order = 0
        scene = scenes.make_scene("synthetic:frames=200,width=64,height=48", 100, 100, 32, 0)
        yield gpu_works.GpuWorks(scene, torch.device("cpu"))


def test_every_piece_of_work_runs(works: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_works, "WARMUPS", 0)
    monkeypatch.setattr(gpu_works, "ITERATIONS", 2)
    monkeypatch.setattr(gpu_works, "TRACKING_ITERATIONS", 2)
    found = gpu_works.time_works(works, 2)
    assert set(found) == {work for _, work in gpu.COLUMNS}
    assert all(time["median_ms"] > 0 for time in found.values()) and float(works.all.alpha.max()) > 0.1
    assert works.field.steps == 2, "mapping took its iterations"


def figures(tracking_ms: float, peer: bool) -> dict[str, Any]:
    works = {work: {"median_ms": 1.0} for _, work in gpu.COLUMNS} | {"both_all": {"median_ms": 1.2}}
    works["tracking_iteration"] = {"median_ms": tracking_ms}
    times = {"forward": {"median_ms": 0.5}, "both": {"median_ms": 3.0}, "mean_color_difference": 1e-4}
    scene = {"splats": 300_000, "width": 1200, "height": 680, "peak_mib": 9.0, "gsplat": times if peer else None}
    slam = {"frames_per_s": 31.0}
    return {"device": {"name": "GPU", "torch": "2"}, "scenes": [scene | {"works": works}], "slam": slam}


def test_goals_are_judged() -> None:
    made = gpu.sections({"figures": figures(2.5, peer=True)})
    assert [section.title for section in made] == ["Times, ms", "Beside gsplat, colour and depth, ms", "Goals"]
    assert [row[3] for row in made[-1].rows] == ["**no**", "**no**", "yes", "yes", "yes"]
    assert all(len(row) == len(section.columns) for section in made for row in section.rows)
    alone = gpu.sections({"figures": figures(1.0, peer=False)})
    assert [row[3] for row in alone[-1].rows] == ["**no**", "yes", "yes", "yes"] and len(alone) == 2


def test_what_was_measured_is_kept_when_the_rest_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise BackendError("the device is gone")

    asked, made = list[Any](), figures(1.0, peer=False)
    monkeypatch.setattr(gpu_works, "refuse_without_device", lambda: None)
    monkeypatch.setattr(gpu_works, "describe_device", lambda: made["device"])
    monkeypatch.setattr(gpu_works, "measure", lambda *given: asked.append(given) or made["scenes"][0])
    monkeypatch.setattr(gpu_works, "time_slam", fail)
    assert gpu.main(gpu.Options(splats=(2000, 1000), out=tmp_path, alone=True)) == 2
    assert [given[:3] for given in asked] == [(*size, n) for size in gpu.SIZES for n in (1000, 2000)]
    assert not any(given[-1] for given in asked), "gsplat was to be left out"
    (kept,) = tmp_path.iterdir()
    assert len(record.read(kept)["figures"]["scenes"]) == 4


def test_a_peer_that_does_not_run_is_left_out(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def broken(*_: Any) -> None:
        raise RuntimeError("no nvcc")

    monkeypatch.setattr(gpu_works, "_time_gsplat", broken)
    monkeypatch.setattr(gpu_works.importlib.util, "find_spec", lambda name: object())
    assert gpu_works.time_gsplat(None, 1, torch.device("cpu")) is None and "no nvcc" in capsys.readouterr().err


@pytest.mark.skipif(cuda_launch.missing() is None, reason="there is a CUDA device")
def test_without_a_device_it_refuses_in_one_line() -> None:
    made = subprocess.run([sys.executable, BENCHMARKS / "gpu.py"], capture_output=True, text=True, timeout=120)
    assert made.returncode == 2 and made.stdout == ""
    assert made.stderr.startswith("gpu.py: nothing to time: ") and len(made.stderr.splitlines()) == 1
