"""`run --log`: the values of every frame in CSV, TensorBoard and rerun, also of a resumed run."""

import csv
import sys
from pathlib import Path

import pytest

from command_line import exit_code
from sigmasplat.plugins.presets.base import BASE
from sigmasplat.run import step_logs
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.slam.results import Step

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES = 5
ROOM = "synthetic:frames=60,width=64,height=48"
TINY = ("--set", "input.width=64", "--set", "mapping.first_iterations=3", "--set", "final.iterations=0")


def run(out: Path, *more: str) -> RunFolder:
    assert exit_code("run", ROOM, "--limit", str(FRAMES), "--no-eval", "--out", str(out), *TINY, *more) == 0
    return RunFolder(out)


def csv_rows(found: RunFolder) -> list[dict[str, str]]:
    with (found.logs / "steps.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_csv_has_the_values_of_the_log(tmp_path: Path) -> None:
    found = run(tmp_path / "run", "--log", "csv")
    rows, log = csv_rows(found), found.read_log()
    assert len(rows) == len(log) == FRAMES
    for row, line in zip(rows, log, strict=True):
        assert int(row["index"]) == line["index"] and row["state"] == line["state"]
        assert [float(row[name]) for name in ("x_m", "y_m", "z_m")] == [T[3] for T in line["T_world_camera"][:3]]
        assert int(row["splats"]) == line["splats"] and float(row["seconds.total"]) == line["seconds"]["total"]
        known = line["tracking"].get("overlap")
        assert row["tracking.overlap"] == ("" if known is None else str(known))
    again = run(tmp_path / "run", "--overwrite")
    assert not again.logs.exists()


def test_a_resumed_run_replaces_the_lines_after_its_state(tmp_path: Path) -> None:
    found = RunFolder.create(tmp_path / "run", BASE, "room")
    whole = run(tmp_path / "whole")
    lines = whole.read_log()
    with step_logs.step_logs(["csv"], found) as (log,):
        for line in lines[:4]:
            log(step_of(line))
    with step_logs.step_logs(["csv"], found, first_index=2) as (log,):
        for line in lines[2:]:
            log(step_of(line))
    assert [int(row["index"]) for row in csv_rows(found)] == list(range(FRAMES))


def step_of(line: dict) -> Step:
    import numpy as np

    values = {name: line[name] for name in ("index", "timestamp_s", "is_keyframe", "lost", "tracking", "splats")}
    more = {name: line[name] for name in ("submap", "seconds", "state", "component", "p_off")}
    return Step(**values, **more, T_world_camera=np.array(line["T_world_camera"]), loops=())


def test_tensorboard_has_a_curve_per_number(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="tensorboard is not installed (extra `logs`)")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found = run(tmp_path / "run", "--log", "csv,tensorboard")
    curves = EventAccumulator(str(found.logs / "tensorboard")).Reload()
    points = [(point.step, point.value) for point in curves.Scalars("splats")]
    assert points == [(line["index"], line["splats"]) for line in found.read_log()]
    assert "tracking/agreement" in curves.Tags()["scalars"]


def test_rerun_writes_a_recording(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra `logs`)")
    found = run(tmp_path / "run", "--log", "rerun")
    assert (found.logs / "steps.rrd").read_bytes()[:4].startswith(b"RR")


@pytest.mark.parametrize(
    ("names", "says"),
    [("csv,tensorbord", "no log 'tensorbord'"), ("rerun", "sigmasplat[logs]"), ("tensorboard", "sigmasplat[logs]")],
)
def test_mistakes_are_one_line_and_leave_nothing(
    names: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("rerun", "torch.utils.tensorboard"):
        monkeypatch.setitem(sys.modules, module, None)
    assert exit_code("run", ROOM, "--out", str(tmp_path / "run"), "--log", names) == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1 and not (tmp_path / "run").exists()
