"""The run folder: files are read back unchanged, and an interruption at any time leaves it readable."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from paper_settings import InputConfig
from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import RunError
from sigmasplat.files import atomic
from sigmasplat.files.json_files import to_json
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder

CONFIG = replace(BASE, name="test", seed=7, input=InputConfig(width=160))


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    return RunFolder.create(tmp_path / "out" / "run", CONFIG, "/data/room")


def test_a_new_run_records_how_it_was_made(run: RunFolder) -> None:
    facts = RunFolder.open(run.path).facts()
    assert facts["program"] == "sigmasplat" and facts["source"] == "/data/room" and facts["status"] == "running"
    assert facts["machine"]["cpu"] and facts["machine"]["cores"] >= 1 and facts["version"]
    assert run.config() == CONFIG


def test_facts_are_added_to_run_json(run: RunFolder) -> None:
    run.note(status="complete", wall_s=12.5)
    facts = run.facts()
    assert facts["status"] == "complete" and facts["wall_s"] == 12.5 and facts["source"] == "/data/room"


def test_files_are_read_back_unchanged(run: RunFolder) -> None:
    path = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    field = GaussianField(torch.randn(5, 17))
    run.write_trajectory(path)
    run.write_map(field)
    run.write_metrics({"ate": {"rmse_m": 0.01}, "psnr": float("nan")})
    np.testing.assert_allclose(run.read_trajectory().T_world_camera, path.T_world_camera)
    torch.testing.assert_close(run.read_map().params, field.params)
    assert run.read_metrics() == {"ate": {"rmse_m": 0.01}, "psnr": None}


def test_checkpoints_keep_tensors_bit_for_bit_even_views(run: RunFolder) -> None:
    base = torch.randn(6, 4)
    tensors = {"rows": base[2:4], "params": base, "again": base, "turned": base.T, "ids": torch.arange(3)}
    run.write_checkpoint(tensors, {"step": "12"})
    back, metadata = run.read_checkpoint()
    assert metadata == {"step": "12"} and all(torch.equal(back[name], tensors[name]) for name in tensors)


def test_the_log_grows_by_complete_lines(run: RunFolder) -> None:
    records = [{"index": i, "pose": np.eye(2) * i, "loss": np.float32(0.5), "bad": float("inf")} for i in range(3)]
    for i, record in enumerate(records):
        run.log(record)
        assert len(run.read_log()) == i + 1, "each line can be read immediately"
    assert run.read_log()[2] == {"index": 2, "pose": [[2.0, 0.0], [0.0, 2.0]], "loss": 0.5, "bad": None}


def test_an_incomplete_last_line_is_skipped_and_other_damage_is_an_error(run: RunFolder) -> None:
    run.log({"index": 0})
    log = run.path / "log.jsonl"
    log.write_text(log.read_text() + '{"index": 1, "sec')
    assert run.read_log() == [{"index": 0}]
    log.write_text('{"index": 0}\n{"ind\n{"index": 2}\n')
    with pytest.raises(RunError, match=r"log\.jsonl:2: not readable as JSON"):
        run.read_log()


def test_ctrl_c_while_writing_keeps_the_old_file(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    old = GaussianField(torch.randn(4, 17))
    run.write_map(old)
    run.write_checkpoint({"a": torch.ones(2)}, {})

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic.os, "replace", interrupt)
    for write in (lambda: run.write_map(GaussianField(torch.randn(9, 17))), lambda: run.write_checkpoint({}, {})):
        with pytest.raises(KeyboardInterrupt):
            write()
    torch.testing.assert_close(run.read_map().params, old.params)
    assert torch.equal(run.read_checkpoint()[0]["a"], torch.ones(2))
    assert not list(run.path.glob(".*")), "no partial file remains"


def test_overwriting_removes_only_the_files_of_a_run(run: RunFolder) -> None:
    run.log({"index": 0})
    (run.path / "notes.txt").write_text("mine")
    again = RunFolder.create(run.path, BASE, "elsewhere", overwrite=True)
    assert again.facts()["source"] == "elsewhere" and (run.path / "notes.txt").read_text() == "mine"
    assert not (run.path / "log.jsonl").exists()


def leave_submaps(run: RunFolder) -> None:
    """Put the files of a killed run into submaps/, and two files of the user."""
    folder = run.submaps.folder
    folder.mkdir()
    for name in ("submap-00000.safetensors", ".submap-00001.safetensors.part", "submap-mine.safetensors", "a.txt"):
        (folder / name).write_text("")


def test_overwriting_removes_loops_and_submaps_but_no_other_files(run: RunFolder) -> None:
    run.write_loops([{"query": 7}])
    leave_submaps(run)
    assert len(run.submaps) == 1
    again = RunFolder.create(run.path, BASE, "elsewhere", overwrite=True)
    assert again.read_loops() == [] and len(again.submaps) == 0
    assert sorted(p.name for p in again.submaps.folder.iterdir()) == ["a.txt", "submap-mine.safetensors"]


def test_loops_are_read_back_and_are_empty_without_a_file(run: RunFolder) -> None:
    assert run.read_loops() == []
    run.write_loops([{"query": 7, "database": 0, "chi2": float("nan"), "T": np.eye(2)}])
    assert run.read_loops() == [{"query": 7, "database": 0, "chi2": None, "T": [[1.0, 0.0], [0.0, 1.0]]}]


KILLED_AT = ["mkdir", "write_text", "replace", "unlink"]
"""The functions that a new run calls while it prepares its folder."""


@pytest.mark.parametrize("earlier", [False, True], ids=["fresh", "overwriting"])
@pytest.mark.parametrize("call", KILLED_AT)
@pytest.mark.parametrize("at", range(4))
def test_a_run_killed_at_its_start_leaves_a_folder_that_can_be_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool, call: str, at: int
) -> None:
    out = tmp_path / "run"
    if earlier:
        first = RunFolder.create(out, CONFIG, "first")
        first.log({"index": 0})
        leave_submaps(first)
    kill_at_call(monkeypatch, call, at)
    with suppress(SystemExit):
        RunFolder.create(out, CONFIG, "killed", overwrite=True)
    monkeypatch.undo()
    again = RunFolder.create(out, CONFIG, "again", overwrite=True)
    assert again.facts()["source"] == "again" and again.config() == CONFIG
    assert not (out / "log.jsonl").exists() and len(again.submaps) == 0


def kill_at_call(monkeypatch: pytest.MonkeyPatch, call: str, at: int) -> None:
    """End the program without any clean-up, as kill -9 does, at a given call of a file function."""
    owner = atomic.os if call == "replace" else Path
    real, calls = getattr(owner, call), iter(range(1000))

    def counted(*arguments: Any, **options: Any) -> Any:
        if next(calls) == at:
            monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
            raise SystemExit
        return real(*arguments, **options)

    monkeypatch.setattr(owner, call, counted)


def test_a_folder_with_a_partial_run_json_counts_as_empty(tmp_path: Path) -> None:
    (tmp_path / ".run.json.part").write_text('{"prog')
    assert RunFolder.create(tmp_path, CONFIG, "room").facts()["status"] == "running"
    assert not (tmp_path / ".run.json.part").exists()


def test_values_are_converted_to_json() -> None:
    value = {"a": np.arange(2), "b": [torch.tensor(1.5), np.bool_(True)], "c": (Path("x"), None, float("nan"))}
    back = json.loads(json.dumps(to_json(value), allow_nan=False))
    assert back == {"a": [0, 1], "b": [1.5, True], "c": ["x", None, None]}
