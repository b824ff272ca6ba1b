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
gpu, gpu_profile, gpu_slam, gpu_works, record, scenes = map(
    importlib.import_module, ("gpu", "gpu_profile", "gpu_slam", "gpu_works", "record", "scenes")
)
DEVICE = {"name": "GPU", "torch": "2", "driver": None}


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
    works = {work: {"median_ms": 0.3} for _, work in gpu.COLUMNS} | {"both_all": {"median_ms": 1.2}}
    works["tracking_iteration"] = {"median_ms": tracking_ms}
    times = {"forward": {"median_ms": 0.5}, "both": {"median_ms": 0.48}, "mean_color_difference": 1e-4}
    scene = {"splats": 77_000, "width": 640, "height": 480, "peak_mib": 9.0, "gsplat": times if peer else None}
    return {"device": DEVICE, "scenes": [scene | {"works": works}, scene | {"works": works, "width": 1200}]}


def test_goals_are_judged() -> None:
    made = gpu.sections({"figures": figures(0.2, peer=True)})
    assert [section.title for section in made] == ["Times, ms", "Beside gsplat, colour and depth, ms", "Goals"]
    assert [row[3] for row in made[-1].rows] == ["yes", "**no**", "yes", "yes"]
    assert made[-1].rows[1][:3] == ["tracking iteration, ms, 77 k, 640×480", "≤ 0.100", "0.200"]
    assert all(len(row) == len(section.columns) for section in made for row in section.rows)
    alone = gpu.sections({"figures": figures(0.05, peer=False)})
    assert [row[3] for row in alone[-1].rows] == ["yes"] * 3 and len(alone) == 2


def test_runs_of_presets_are_judged() -> None:
    run = {
        "recording": "room", "frames": 60, "first_s": 1.0, "frames_per_s": 90.0, "median_ms": 11.0, "longest_ms": 30.0,
        "lost": 0, "splats": 77_000, "peak_mib": 900.0, "ate_m": 0.01, "apart_m": 5e-4,
    }  # fmt: skip
    rest = {"ate_m": None, "apart_m": None, "frames_per_s": None}
    measured = {"figures": {"device": DEVICE, "runs": [run, run | rest]}, "config": {"preset": "sigma"}}
    runs, goals = gpu_slam.sections(measured)
    assert all(len(row) == len(runs.columns) for row in runs.rows) and runs.rows[1][6] == "–"
    assert [row[1:] for row in goals.rows] == [["≥ 100", "90.0", "**no**"], ["≤ 0.00100", "0.000500", "yes"]]


def test_a_profile_is_laid_out() -> None:
    kernels = [{"kernel": "blend", "runs": 1.0, "us": 40.0}]
    work = {"work": "align", "wall_ms": 1.0, "busy_ms": 0.5, "launches": 9.0, "copies": 1.0, "waits": 1.0}
    given = {"device": DEVICE, "works": [work | {"kernels": kernels}]}
    made = gpu_profile.sections({"figures": given, "config": {"splats": 77_000, "size": [640, 480]}})
    assert made[0].rows == [["align", "1.00", "0.500", "9.00", "1.00", "1.00"]]
    assert made[1].title == "align" and made[1].rows == [["blend", "1.00", "40.0"]]


def test_what_was_measured_is_kept_when_the_rest_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, made = list[Any](), figures(1.0, peer=False)

    def measured(*given: Any) -> Any:
        if len(asked) == 3:
            raise BackendError("the device is gone")
        asked.append(given)
        return made["scenes"][0]

    monkeypatch.setattr(gpu_works, "refuse_without_device", lambda: None)
    monkeypatch.setattr(gpu_works, "describe_device", lambda: made["device"])
    monkeypatch.setattr(gpu_works, "measure", measured)
    assert gpu.main(gpu.Options(splats=(2000, 1000), out=tmp_path, alone=True)) == 2
    assert [given[:3] for given in asked] == [(*size, n) for size in gpu.SIZES for n in (1000, 2000)][:3]
    assert not any(given[-1] for given in asked), "gsplat was to be left out"
    (kept,) = tmp_path.iterdir()
    assert len(record.read(kept)["figures"]["scenes"]) == 3


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
