"""Runs stopped by Ctrl-C or killed: their folders can be read afterwards, or are refused with one line."""

import signal
from pathlib import Path

import pytest
import torch

from command_line import exit_code
from run_process import PATIENCE_S, ROOM, lines, running, wait_for
from sigmasplat.errors import RunError
from sigmasplat.plugins.evaluation.evaluate import evaluate
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")


@pytest.mark.slow
def test_ctrl_c_leaves_a_usable_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    with running(out) as process:
        wait_for(process, lambda: lines(out) >= 3)
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in said + errors and "interrupted after" in said + errors

    run = RunFolder.open(out)
    assert run.facts()["status"] == "interrupted"
    log, path, field = run.read_log(), run.read_trajectory(), run.read_map()
    assert 3 <= len(log) == len(path) < 200
    assert len(field) == log[-1]["splats"] > 100 and torch.isfinite(field.params).all()
    tensors, metadata = run.read_checkpoint()
    assert metadata == {"frames": str(len(log))}
    torch.testing.assert_close(tensors["params"], field.params, rtol=0, atol=1e-5)
    assert run.config().input.width == 80

    assert exit_code("export", str(out), "--out", str(tmp_path / "map.ply")) == 0
    assert (tmp_path / "map.ply").stat().st_size > 1000
    capsys.readouterr()


@pytest.mark.slow
def test_ctrl_c_with_submaps_keeps_them_and_writes_their_map(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with running(out, "submaps.frames=8", "loops.min_interval=1") as process:
        log_file = out / "log.jsonl"
        wait_for(process, lambda: len(RunFolder(out).submaps) >= 2 and '"loops": [' in log_file.read_text())
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "interrupted after" in said and "submaps, loops: " in said

    run = RunFolder.open(out)
    log, kept, (tensors, _) = run.read_log(), run.submaps, run.read_checkpoint()
    assert run.facts()["status"] == "interrupted" and "finish_s" not in run.facts()
    assert 2 <= len(kept) == log[-1]["submap"] and len(tensors["T_world_submap"]) == len(kept) + 1
    assert tensors["frame_submap"].tolist() == [record["submap"] for record in log]
    splats = sum(len(kept.load(index).field) for index in range(len(kept))) + len(tensors["params"])
    assert len(run.read_map()) == splats and torch.isfinite(run.read_map().params).all()
    tried = [loop for record in log for loop in record.get("loops", [])]
    assert tried and [(loop["query"], loop["database"]) for loop in run.read_loops()] == [
        (loop["query"], loop["database"]) for loop in tried
    ]


@pytest.mark.slow
def test_ctrl_c_during_refinement_keeps_the_unrefined_map(tmp_path: Path) -> None:
    out = tmp_path / "run"

    def all_frozen() -> bool:
        return lines(out) == 20 and len(RunFolder(out).submaps) == RunFolder(out).read_log()[-1]["submap"] + 1

    with running(out, "submaps.frames=8", "final.iterations=1000000", "input.limit=20") as process:
        wait_for(process, all_frozen)
        process.send_signal(signal.SIGINT)
        said, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, errors
    assert "Traceback" not in said + errors and "interrupted after 20 frames" in said

    run = RunFolder.open(out)
    assert run.facts()["status"] == "interrupted" and run.facts()["wall_s"] > 0 and "finish_s" not in run.facts()
    splats = sum(len(run.submaps.load(index).field) for index in range(len(run.submaps)))
    assert len(run.read_trajectory()) == 20 and len(run.submaps) >= 2 and len(run.read_map()) == splats
    metrics = evaluate(run, open_source(ROOM, limit=20), views_per_kind=4, strips_per_kind=0)
    assert metrics["held_out_submaps"]["views"] == metrics["held_out"]["views"] == 4


@pytest.mark.parametrize("moment", [pytest.param("folder", marks=pytest.mark.slow), "log"])
def test_a_killed_run_is_read_or_refused_in_one_line_and_can_be_repeated_with_overwrite(
    tmp_path: Path, moment: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    with running(out) as process:
        wait_for(process, out.exists if moment == "folder" else lambda: lines(out) >= 2)
        process.send_signal(signal.SIGKILL)
        process.wait(timeout=PATIENCE_S)
    assert process.returncode == -signal.SIGKILL

    if moment == "log":
        run = RunFolder.open(out)
        assert run.facts()["status"] == "running" and len(run.read_log()) >= 2
        with pytest.raises(RunError, match=r"has no map\.ply; did it stop before writing it"):
            run.read_map()
    else:
        try:
            assert RunFolder.open(out).facts()["status"] == "running"
        except RunError as problem:
            assert "not a run folder" in str(problem)

    for command in (["eval", str(out)], ["export", str(out), "--out", str(tmp_path / "map.ply")]):
        assert exit_code(*command) == 2
        refusal = capsys.readouterr().err
        assert refusal.startswith("sigmasplat: ") and refusal.count("\n") == 1, refusal

    short = ("--set", "input.width=80", "--set", "mapping.first_iterations=2", "--set", "final.iterations=2",
             "--limit", "1", "--no-eval")  # fmt: skip
    room = "synthetic:frames=2,width=80,height=60"
    assert exit_code("run", room, "--out", str(out), "--overwrite", *short) == 0
    assert RunFolder.open(out).facts()["status"] == "complete" and len(RunFolder.open(out).read_log()) == 1
