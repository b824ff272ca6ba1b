"""`bench table` and `batch`: every layout goes through; a killed command changes no result."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

import paper_data
from command_line import exit_code
from lpips_weights import write_weights
from sigmasplat.plugins.batch.batch import Executor
from sigmasplat.plugins.batch.definition import Table
from sigmasplat.plugins.batch.job import Job
from sigmasplat.plugins.batch.make_run import make_run
from sigmasplat.plugins.batch.scores import run_record
from sigmasplat.plugins.evaluation import reconstruct
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

SAME = ("trajectory.txt", "map.ply", "loops.json", "checkpoint.safetensors", "config.json")
TABLES = ("table.md", "table.json")
DEADLINE_S = 240


def arguments(
    out: Path, data: Path, *more: str, table: str = "varsplat-replica", system: str = "VarSplat"
) -> list[str]:
    """Return a tiny table of one system; the state of its runs is saved after every frame."""
    chosen = ["--systems", system, "--seeds", "1", "--save-every", "0.001"]
    return ["bench", "table", table, "--data", str(data), "--out", str(out), *chosen, *paper_data.tiny_options(), *more]


def started(*words: str, log: Path) -> subprocess.Popen:
    with log.open("w") as file:
        return subprocess.Popen([sys.executable, "-m", "sigmasplat", *words], stdout=file, stderr=subprocess.STDOUT)


def wait_for(condition: Callable[[], bool], log: Path, process: subprocess.Popen | None = None) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline_s, log.read_text()
        assert process is None or process.poll() is None, log.read_text()
        time.sleep(0.01)


def frames_logged(out: Path, run: str) -> int:
    log = out / "runs" / run / "log.jsonl"
    return log.read_text().count("\n") if log.exists() else 0


@contextlib.contextmanager
def one_process() -> Iterator[None]:
    """Make runs without a process of their own, which costs more than a tiny run."""

    def made(executor: Executor, jobs: list, out: Path) -> Iterator[tuple[Job, None]]:
        for job in jobs:
            make_run(job, out / job.name, executor.data, executor.save_every_s)
            yield job, None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Executor, "make", made)
        yield


@pytest.fixture
def in_this_process() -> Iterator[None]:
    with one_process():
        yield


@pytest.fixture(scope="module")
def replica(tmp_path_factory: pytest.TempPathFactory) -> Path:
    walks = {scene: paper_data.room(seed) for seed, scene in enumerate(("room0", "office0"))}
    return paper_data.write_replica(tmp_path_factory.mktemp("replica"), walks)


@pytest.fixture(scope="module")
def whole(replica: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a table that was made without a break, one run after the other."""
    out = tmp_path_factory.mktemp("whole") / "table"
    with one_process():
        assert exit_code(*arguments(out, replica)) == 0
    return out


def assert_same(out: Path, whole: Path) -> None:
    for name in TABLES:
        assert (out / name).read_text() == (whole / name).read_text()
    assert_same_runs(out, whole, "room0-varsplat-seed0", "office0-varsplat-seed0")


def assert_same_runs(out: Path, whole: Path, *runs: str) -> None:
    for run in runs:
        for name in SAME:
            assert (out / "runs" / run / name).read_bytes() == (whole / "runs" / run / name).read_bytes(), (run, name)


def test_a_table_has_the_scores_of_the_scenes_that_exist(whole: Path) -> None:
    values = json.loads((whole / "table.json").read_text())
    ate = {
        row["origin"]: row["values"]
        for row in values["rows"]
        if row["score"] == "ATE, keyframes" and row["system"] == "VarSplat"
    }
    measured = {
        scene: 100 * RunFolder(whole / "runs" / f"{scene}-varsplat-seed0").read_metrics()["ate_keyframes"]["rmse_m"]
        for scene in ("room0", "office0")
    }
    assert {scene: ate["ours"][scene]["mean"] for scene in measured} == pytest.approx(measured)
    assert (
        ate["ours"]["mean"]["mean"] == pytest.approx(sum(measured.values()) / 2) and ate["ours"]["mean"]["scenes"] == 2
    )
    assert ate["paper"]["mean"]["mean"] == 0.23
    text = (whole / "table.md").read_text()
    assert "room1" in text and "Not the settings of the paper" in text and "(2 of 8 scenes)" in text


def test_a_finished_table_is_not_run_again(whole: Path, replica: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in (whole / "runs").rglob("log.jsonl")}
    assert exit_code(*arguments(whole, replica)) == 0
    assert {path: path.stat().st_mtime_ns for path in (whole / "runs").rglob("log.jsonl")} == before
    assert "no room1 in" in capsys.readouterr().out
    assert exit_code(*arguments(whole, replica, "--set", "mapping.iterations=2")) == 2
    assert "runs of other settings" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_table_ends_as_one_that_was_not_stopped(tmp_path: Path, replica: Path, whole: Path) -> None:
    out, log, run = tmp_path / "table", tmp_path / "log", "office0-varsplat-seed0"
    process = started(*arguments(out, replica), log=log)
    after = 2 + os.getpid() % (paper_data.FRAMES - 3)
    wait_for(lambda: frames_logged(out, run) >= after, log, process)
    process.kill()
    process.wait()
    logged = frames_logged(out, run)
    assert exit_code(*arguments(out, replica)) == 0, f"killed after {logged} frames"
    assert_same(out, whole)


LAYOUTS = {
    "replica": lambda root, walk: paper_data.write_replica(root, {"room0": walk, "office0": walk}),
    "tum": paper_data.write_tum,
    "scannet": paper_data.write_scannet,
    "scannetpp": paper_data.write_scannetpp,
}
SYNTHETIC, LIVINGROOM, REDKITCHEN = "synthetic", "livingroom", "redkitchen"
ATE, VIEWS = ("ATE, keyframes", "ATE, all frames"), ("PSNR",)
EVERY_TABLE = [
    ("cgslam-replica", "CG-SLAM", "replica", LIVINGROOM, (*ATE, *VIEWS)),
    ("varsplat-tum", "VarSplat", "tum", SYNTHETIC, (*ATE, *VIEWS)),
    ("cgslam-tum", "CG-SLAM", "tum", REDKITCHEN, ATE),
    ("varsplat-scannet", "VarSplat", "scannet", REDKITCHEN, (*ATE, *VIEWS)),
    ("cgslam-scannet", "CG-SLAM light", "scannet", SYNTHETIC, ATE),
    ("varsplat-scannetpp", "VarSplat", "scannetpp", SYNTHETIC, (*ATE, "novel view PSNR")),
    ("varsplat-scannetpp", "LoopSplat", "scannetpp", LIVINGROOM, (*ATE, "novel view PSNR")),
    ("varsplat-ablation", "+registration", "scannet", SYNTHETIC, ATE),
    ("varsplat-variance", "without depth", "scannet", REDKITCHEN, ATE),
    ("cgslam-ablation", "without alignment", "replica", SYNTHETIC, ATE),
    ("varsplat-runtime", "VarSplat", "replica", LIVINGROOM, ("mapping per frame", "tracking per frame")),
    ("cgslam-runtime", "CG-SLAM", "replica", SYNTHETIC, ("tracking per iteration", "mapping per iteration", "map")),
]
"""Tables, a system of each, a layout, where its frames are from, and the scores that its scene must have."""
QUICK = {"varsplat-scannetpp-synthetic"}
"""Not marked slow, for its views away from the path; `whole` is a table, too."""


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(
    ("table", "system", "layout", "frames", "scores"),
    [
        pytest.param(*row, id=id, marks=() if id in QUICK else pytest.mark.slow)
        for row in EVERY_TABLE
        for id in [f"{row[0]}-{row[3]}"]
    ],
)
def test_every_table_is_made_from_its_layout(
    table: str, system: str, layout: str, frames: str, scores: tuple[str, ...], tmp_path: Path,
    data_folder: Callable[[str], Path],
) -> None:  # fmt: skip
    walk = paper_data.room(5) if frames == SYNTHETIC else paper_data.recorded(data_folder(frames))
    data, scene = LAYOUTS[layout](tmp_path / "tree", walk), Table.read(table).scenes[0].name
    assert exit_code(*arguments(tmp_path / "out", data, "--scenes", scene, table=table, system=system)) == 0
    rows = json.loads((tmp_path / "out/table.json").read_text())["rows"]
    ours = {row["score"]: row["values"].get(scene) for row in rows if row["origin"] == "ours"}
    assert all(ours[score] is not None and ours[score]["mean"] > 0 for score in scores), ours


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.slow
def test_replicas_true_mesh_and_the_weights_of_lpips_fill_their_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The walk turns enough, and is tracked well enough, that its alignment is determined."""
    monkeypatch.chdir(tmp_path)
    ours, published = reconstruct.reconstruction.score, reconstruct.score_published
    few = {"points": 10_000}
    monkeypatch.setattr(reconstruct.reconstruction, "score", partial(ours, **few))
    monkeypatch.setattr(reconstruct, "score_published", lambda *a, **n: published(*a, **n | few | {"views": 40}))
    write_weights(tmp_path / "data/lpips")
    data = paper_data.write_replica(tmp_path / "Replica", {"room0": paper_data.room(0, 60)}, surfaces=True)
    better = ["--set", "tracking.method=align", "--set", "mapping.first_iterations=30"]
    assert exit_code(*arguments(tmp_path / "out", data, "--scenes", "room0", *better)) == 0
    rows = json.loads((tmp_path / "out/table.json").read_text())["rows"]
    ours = {
        row["score"]: row["values"]["room0"]["mean"]
        for row in rows
        if "room0" in row["values"] and row["origin"] == "ours"
    }
    assert ours["depth L1"] < 20 and 10 < ours["F1"] <= 100 and 0 < ours["LPIPS"] < 1
    record = run_record(tmp_path / "out/runs/room0-varsplat-seed0")
    of_run = {
        score.name: score.value(record)
        for name in ("cgslam-replica", "cgslam-ablation")
        for score in Table.read(name).scores
    }
    too_small = {"SSIM"}  # on several scales, which 80 × 60 pixels do not have
    assert {name for name, value in of_run.items() if value is None} == too_small
    assert 0 < of_run["accuracy"] < 10 and 0 < of_run["completion"] < 10 and of_run["completion ratio"] > 50


@pytest.mark.slow
def test_a_batch_keeps_what_is_done_and_names_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = f"synthetic:frames=40,width={paper_data.WIDTH},height={paper_data.HEIGHT}"
    words = ["batch", room, str(tmp_path / "absent"), "--out", str(tmp_path / "out"), "--limit", "6"]
    assert exit_code(*words, *paper_data.tiny_options()) == 1
    said = capsys.readouterr().out
    assert "missing: no such folder or file" in said and "1 of 2 runs" in said
    assert exit_code(*words, *paper_data.tiny_options()) == 1
    assert "1 of 2 runs are finished" in capsys.readouterr().out
    del words[2]
    assert exit_code(*words, "--seeds", "2", *paper_data.tiny_options()) == 0
    first, second = (RunFolder(path) for path in sorted((tmp_path / "out").iterdir()))
    assert second.path.name == f"{first.path.name}-seed1" and (first.config().seed, second.config().seed) == (0, 1)


@pytest.mark.slow
def test_ctrl_c_saves_the_running_run(tmp_path: Path, replica: Path, whole: Path) -> None:
    out, log, run = tmp_path / "table", tmp_path / "log", "office0-varsplat-seed0"
    words = [word if word != "0.001" else "0" for word in arguments(out, replica, "--scenes", "office0")]
    process = started(*words, log=log)
    wait_for(lambda: frames_logged(out, run) >= 3, log, process)
    process.send_signal(signal.SIGINT)
    assert process.wait(DEADLINE_S) == 130 and "repeat the command" in log.read_text()
    facts = RunFolder(out / "runs" / run).facts()
    assert facts["status"] in ("interrupted", "complete")
    assert exit_code(*words) == 0
    assert_same_runs(out, whole, run)
