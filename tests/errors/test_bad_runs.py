"""Run folders that cannot be used: one line that says what is wrong and what to do, and nothing is deleted."""

from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError

from sigmasplat.errors import ConfigError, RunError
from sigmasplat.files import tensors
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder


def make(path: Path) -> RunFolder:
    return RunFolder.create(path, BASE, "room")


def refused(path: Path, overwrite: bool = False) -> str:
    with pytest.raises(RunError) as caught:
        RunFolder.create(path, BASE, "room", overwrite=overwrite)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


def test_an_existing_run_is_kept_without_overwrite(tmp_path: Path) -> None:
    make(tmp_path / "run").log({"index": 0})
    assert "--overwrite" in refused(tmp_path / "run")
    assert len(RunFolder.open(tmp_path / "run").read_log()) == 1


@pytest.mark.parametrize("names", [["photo.jpg"], ["config.json"], ["run.json"], ["config.json", "run.json"]])
def test_a_folder_of_another_program_is_never_overwritten(tmp_path: Path, names: list[str]) -> None:
    for name in names:
        (tmp_path / name).write_text('{"model": "theirs"}')
    assert "not a run folder" in refused(tmp_path, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(names)
    assert all((tmp_path / name).read_text() == '{"model": "theirs"}' for name in names)


def test_a_run_without_settings_can_be_overwritten(tmp_path: Path) -> None:
    """A run that was killed before it wrote its settings leaves such a folder."""
    run = make(tmp_path / "run")
    (run.path / "config.json").unlink()
    assert "--overwrite" in refused(run.path)
    again = RunFolder.create(run.path, BASE, "room", overwrite=True)
    assert RunFolder.open(again.path).facts()["status"] == "running"


def test_an_empty_folder_is_used(tmp_path: Path) -> None:
    assert make(tmp_path).facts()["status"] == "running"


def test_output_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    assert "is a file; give a folder" in refused(tmp_path / "out")


def test_output_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "choose a writable --out" in refused(tmp_path / "file" / "run")
    assert "choose a writable --out" in refused(Path("/proc/sigmasplat-run"))


def test_opening_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no run folder .*/nothing; `sigmasplat run` creates one"):
        RunFolder.open(tmp_path / "nothing")
    with pytest.raises(RunError, match=r"no config\.json and no run\.json"):
        RunFolder.open(tmp_path)
    run = make(tmp_path / "run")
    (run.path / "config.json").unlink()
    with pytest.raises(RunError, match=r"not a run folder: no config\.json$"):
        RunFolder.open(run.path)


def test_reading_a_missing_file_is_refused(tmp_path: Path) -> None:
    run = make(tmp_path / "run")
    for name, read in {
        "trajectory.txt": run.read_trajectory,
        "map.ply": run.read_map,
        "checkpoint.safetensors": run.read_checkpoint,
        "log.jsonl": run.read_log,
        "metrics.json": run.read_metrics,
    }.items():
        with pytest.raises(RunError, match=f"has no {name}; did it stop before writing it"):
            read()


def test_damaged_files_are_named(tmp_path: Path) -> None:
    run = make(tmp_path / "run")
    (run.path / "checkpoint.safetensors").write_bytes(b"\0" * 5)
    with pytest.raises(RunError, match=r"checkpoint .* is damaged"):
        run.read_checkpoint()
    (run.path / "metrics.json").write_text("{")
    with pytest.raises(RunError, match=r"metrics\.json.*JSON"):
        run.read_metrics()
    (run.path / "metrics.json").write_text("[1]")
    with pytest.raises(RunError, match="is not a JSON object"):
        run.read_metrics()
    for text, complaint in (
        ("{", r"loops\.json: not read"),
        ("{}", "a list of loops"),
        ("[1]", "a list of loops"),
    ):
        (run.path / "loops.json").write_text(text)
        with pytest.raises(RunError, match=complaint):
            run.read_loops()
    (run.path / "run.json").write_text("half a f")
    with pytest.raises(RunError, match=r"run\.json: not readable as JSON"):
        RunFolder.open(run.path)
    (run.path / "config.json").write_text('{"sede": 1}')
    with pytest.raises(ConfigError, match="unknown setting 'sede'"):
        run.config()


def test_a_run_folder_deleted_during_the_run_is_reported(tmp_path: Path) -> None:
    run = RunFolder(tmp_path / "gone")
    with pytest.raises(RunError, match=r"cannot write .*log\.jsonl"):
        run.log({"index": 0})
    with pytest.raises(RunError, match=r"cannot write .*metrics\.json"):
        run.write_metrics({})
    with pytest.raises(RunError, match=r"cannot write .*checkpoint\.safetensors"):
        run.write_checkpoint({"a": torch.ones(2)}, {})


def test_a_full_disk_gives_one_line_and_no_partial_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = make(tmp_path / "run")

    def full(tensors: object, path: Path, text: object) -> None:
        path.write_text("half")
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(tensors, "save_file", full)
    with pytest.raises(RunError, match=r"cannot write .*checkpoint\.safetensors: .*No space left") as caught:
        run.write_checkpoint({"a": torch.ones(2)}, {})
    assert "\n" not in str(caught.value) and not list(run.path.glob(".*"))
