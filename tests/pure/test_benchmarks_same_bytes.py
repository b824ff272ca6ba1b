"""benchmarks/same_bytes.py: every difference in what a run computed is found, and nothing else counts."""

import importlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
names = ("same_bytes", "same_bytes_results", "same_bytes_cases", "checkouts", "record")
same_bytes, results, cases, checkouts, record = map(importlib.import_module, names)

PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty float x\nend_header\n"


def write_run(folder: Path, seconds: float = 1.0) -> Path:
    """Write a run folder; only its times depend on `seconds`."""
    (folder / "submaps").mkdir(parents=True)
    (folder / "images").mkdir()
    (folder / "images" / "a.png").write_bytes(str(seconds).encode())
    (folder / "config.json").write_text(json.dumps({"seed": seconds}))
    log = [{"index": i, "tracking": {"loss": 0.5 * i, "doubtful": 0.0}, "seconds": {"map": seconds}} for i in range(3)]
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in log))
    (folder / "metrics.json").write_text(json.dumps({"ate": {"rmse_m": 0.25}, "wall_s": seconds, "loops": []}))
    (folder / "run.json").write_text(json.dumps({"code": str(seconds), "machine": {"cores": seconds}, "skipped": []}))
    (folder / "trajectory.txt").write_text("# t tx ty tz\n0.5 0 0 1\n0.75 0 0 2\n")
    (folder / "map.ply").write_bytes(PLY + np.array([1.0, 2.0], "<f4").tobytes())
    tensors = {"params": np.array([[1.0, -0.0], [np.nan, 4.0]], np.float32), "frames": np.arange(3)}
    save_file(tensors, folder / "submaps" / "submap-00000.safetensors", {"index": "0"})
    return folder


def edit_text(name: str, old: str, new: str) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return edit


def edit_tensor(name: str, place: tuple[int, ...], value: float) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        path = folder / "submaps" / "submap-00000.safetensors"
        with safe_open(path, "np") as stored:
            tensors, metadata = {key: stored.get_tensor(key) for key in sorted(stored.keys())}, stored.metadata()
        tensors[name][place] = value
        save_file(tensors, path, metadata)

    return edit


def edit_map(folder: Path) -> None:
    (folder / "map.ply").write_bytes(PLY + np.array([1.0, 2.5], "<f4").tobytes())


def remove_submap(folder: Path) -> None:
    (folder / "submaps" / "submap-00000.safetensors").unlink()


def add_component(folder: Path) -> None:
    (folder / "components").mkdir()
    (folder / "components" / "a.bin").write_bytes(b"a")


SUBMAP = "submaps/submap-00000.safetensors"
LOG, METRICS, PATH = "log.jsonl", "metrics.json", "trajectory.txt"
LOSSES = "2 of 9 values differ, first 0.tracking.loss: 0.0 → 2.0 (2); largest difference 2 in 0.tracking.loss"
KEYS = "only before: *.tracking.doubtful (3×); only now: *.tracking.unsure (3×)"


def one(of: int, said: str) -> str:
    return f"1 of {of} values differ, first {said}{' apart' if 'at most' in said else ''}"


CHANGES = [
    (edit_text(METRICS, "0.25", "0.26"), METRICS, one(2, "ate.rmse_m: 0.25 → 0.26 (0.01)")),
    (edit_text(METRICS, "0.25", "null"), METRICS, one(2, "ate.rmse_m: 0.25 → None")),
    (edit_text(METRICS, "[]", "[1]"), METRICS, "only before: loops; only now: loops.*"),
    (edit_text("run.json", "[]", "[3]"), "run.json", "only before: skipped; only now: skipped.*"),
    (edit_text(LOG, "doubtful", "unsure"), LOG, KEYS),
    (edit_text(LOG, '1.0, "d', '1.5, "d'), LOG, one(9, "2.tracking.loss: 1.0 → 1.5 (0.5)")),
    (edit_text(LOG, '"loss": 0', '"loss": 2'), LOG, LOSSES),
    (edit_text(PATH, "0 1", "0 1.5"), PATH, one(13, "1.3: 1.0 → 1.5 (0.5)")),
    (edit_text(PATH, "tx", "x"), PATH, one(13, "0.2: 'tx' → 'x'")),
    (edit_tensor("params", (1, 1), 4.5), SUBMAP, one(3, "params: 1 of 4 elements, [1, 1]: 4.0 → 4.5, at most 0.5")),
    (edit_tensor("params", (0, 1), 0.0), SUBMAP, one(3, "params: 1 of 4 elements, [0, 1]: -0.0 → 0.0, at most 0")),
    (edit_tensor("params", (1, 0), 7.0), SUBMAP, one(3, "params: 1 of 4 elements, [1, 0]: nan → 7.0, at most 0")),
    (edit_tensor("frames", (2,), 9), SUBMAP, one(3, "frames: 1 of 3 elements, [2]: 2 → 9, at most 7")),
    (edit_map, "map.ply", one(2, "rows: 1 of 2 elements, [1]: 2.0 → 2.5, at most 0.5")),
    (remove_submap, SUBMAP, "only before"),
    (add_component, "components/a.bin", "only now"),
]


@pytest.mark.parametrize(("change", "file", "said"), CHANGES, ids=[f"{i}-{c[1]}" for i, c in enumerate(CHANGES)])
def test_a_difference_is_found_and_said(change: Callable[[Path], None], file: str, said: str, tmp_path: Path) -> None:
    before, now = write_run(tmp_path / "before"), write_run(tmp_path / "now", seconds=2.0)
    change(now)
    assert results.differences(results.read_run(before, {}), results.read_run(now, {})) == {file: said}


def test_times_machine_settings_pictures_and_the_order_of_metadata_do_not_count(tmp_path: Path) -> None:
    before, now = write_run(tmp_path / "before"), write_run(tmp_path / "now", seconds=2.0)
    for folder, order in ((before, 1), (now, -1)):
        header = {"__metadata__": dict([("a", "1"), ("b", "2")][::order])}
        header["x"] = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}  # type: ignore[dict-item]
        text = json.dumps(header).encode()
        (folder / "checkpoint.safetensors").write_bytes(len(text).to_bytes(8, "little") + text + bytes(4))
    assert (before / "checkpoint.safetensors").read_bytes() != (now / "checkpoint.safetensors").read_bytes()
    assert results.differences(results.read_run(before, {}), results.read_run(now, {})) == {}
    assert set(results.read_run(now, {})) >= {"checkpoint.safetensors", "map.ply", "trajectory.txt", SUBMAP}


def test_renamed_keys_and_files_are_compared_under_the_new_name(tmp_path: Path) -> None:
    before, now = write_run(tmp_path / "before"), write_run(tmp_path / "now")
    edit_text("log.jsonl", "doubtful", "unsure")(now)
    (now / "trajectory.txt").rename(now / "path.txt")
    edit_text("metrics.json", '"loops"', '"ways"')(now)
    renamed = {"tracking.doubtful": "tracking.unsure", "trajectory.txt": "path.txt", "loops": "", "ways": ""}
    assert results.differences(results.read_run(before, renamed), results.read_run(now, renamed)) == {}
    edit_text("log.jsonl", '"unsure": 0.0', '"unsure": 1.0')(now)
    found = results.differences(results.read_run(before, renamed), results.read_run(now, renamed))
    assert found["log.jsonl"].startswith("3 of 9 values differ, first 0.tracking.unsure: 0.0 → 1.0")


# ---- the program ----


class Sides:
    """Stands for both checkouts: writes run folders instead of running SLAM, and notes each command."""

    def __init__(self) -> None:
        self.tree = Path("before")
        self.ran: list[tuple[str, str]] = []
        self.change: Callable[[Path], None] | None = None
        self.code: dict[str, int] = {}
        """Exit code of a command of the other commit by a text in it."""

    def run(self, tree: Path, words: list[str], folder: Path) -> tuple[int, object]:
        side, text = "before" if tree == self.tree else "now", " ".join(words)
        self.ran.append((side, text))
        shutil.rmtree(folder, ignore_errors=True)
        write_run(folder, seconds=len(self.ran))
        if side == "now" and self.change:
            self.change(folder)
        code = max([code for part, code in self.code.items() if part in text and side == "before"], default=0)
        return code, same_bytes.Ran(folder, 1.0, "it broke" if code else None)


@pytest.fixture
def sides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sides:
    made = Sides()
    monkeypatch.setattr(same_bytes, "run", made.run)
    monkeypatch.setattr(same_bytes, "NOW", tmp_path / "now")
    monkeypatch.setattr(checkouts, "checkout", lambda revision: made.tree)
    monkeypatch.setattr(checkouts, "commit_of", lambda revision: "c" * 40)
    monkeypatch.setattr(checkouts, "built", lambda tree: True)
    monkeypatch.setattr(same_bytes, "CASES", {"room-sigma": "synthetic --limit 3", "room-fast": "synthetic --preset b"})
    monkeypatch.setattr(same_bytes, "SPELLED_BEFORE", {})
    monkeypatch.setattr(same_bytes, "RENAMED", {})
    monkeypatch.setenv("SIGMASPLAT_BEFORE", str(tmp_path / "kept"))
    return made


def options(*only: str, **more: object) -> object:
    return same_bytes.Options("HEAD", only, jobs=1, **more)


def test_results_of_the_other_commit_are_kept(sides: Sides, capsys: pytest.CaptureFixture[str]) -> None:
    assert same_bytes.main(options()) == 0
    assert sorted(side for side, _ in sides.ran) == ["before", "before", "now", "now"]
    sides.ran.clear()
    assert same_bytes.main(options("sigma")) == 0
    assert sides.ran == [("now", "run synthetic --limit 3")]
    assert "1 of 1 runs are the same" in capsys.readouterr().out


def test_a_difference_ends_with_1_and_is_printed(sides: Sides, capsys: pytest.CaptureFixture[str]) -> None:
    sides.change = edit_text("metrics.json", "0.25", "0.5")
    assert same_bytes.main(options("room,fast")) == 1
    said = capsys.readouterr().out
    assert "DIFFERENT  room-fast" in said and "    metrics.json: 1 of 2 values differ, first ate.rmse_m" in said
    assert same_bytes.main(options("fast", rename=("ate.rmse_m=",))) == 0


def test_the_other_commit_gets_its_own_spelling_unless_it_refuses_it(
    sides: Sides, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(same_bytes, "SPELLED_BEFORE", {"--preset b": "--preset a --set x=1"})
    assert same_bytes.main(options("fast")) == 0
    assert sides.ran == [("before", "run synthetic --preset a --set x=1"), ("now", "run synthetic --preset b")]
    sides.ran.clear()
    sides.code = {"y=1": 2}
    monkeypatch.setattr(same_bytes, "SPELLED_BEFORE", {"--preset b": "--preset a --set y=1"})
    assert same_bytes.main(options("fast")) == 0
    assert [text for side, text in sides.ran if side == "before"][1] == "run synthetic --preset b"


def test_a_run_that_fails_is_a_difference_and_not_kept(sides: Sides, capsys: pytest.CaptureFixture[str]) -> None:
    sides.code = {"--limit 3": 1}
    assert same_bytes.main(options("sigma")) == 1 and same_bytes.main(options("sigma")) == 1
    assert [side for side, _ in sides.ran] == ["before", "now"] * 2
    assert "before fails: it broke" in capsys.readouterr().out


def test_two_empty_folders_are_not_the_same_results(sides: Sides, capsys: pytest.CaptureFixture[str]) -> None:
    everything = ("submaps", "log.jsonl", "metrics.json", "run.json", "trajectory.txt", "map.ply", SUBMAP)
    assert same_bytes.main(options("sigma", rename=tuple(f"{name}=" for name in everything))) == 1
    assert "no results" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"only": ("nothing",)}, "no run has 'nothing'"),
        ({"only": ("fast,sigma",)}, "no run has 'fast,sigma'"),
        ({"rename": ("tracking",)}, "old=new"),
        ({"rename": ("=tracking",)}, "old=new"),
        ({"jobs": 0}, "--jobs"),
    ],
)
def test_wrong_options_are_refused_in_one_line(
    more: dict[str, object], said: str, sides: Sides, capsys: pytest.CaptureFixture[str]
) -> None:
    assert same_bytes.main(same_bytes.Options("HEAD", **more)) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and not sides.ran


def test_a_missing_recording_is_refused(
    sides: Sides, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SIGMASPLAT_DATA", str(tmp_path))
    monkeypatch.setattr(same_bytes, "CASES", {"a": "kitchen --limit 3"})
    assert same_bytes.main(options()) == 2
    assert str(tmp_path / "kitchen") in capsys.readouterr().err and not sides.ran


def test_old_kernels_and_unknown_commits_are_refused(
    sides: Sides, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(checkouts, "built", lambda tree: False)
    monkeypatch.setattr(same_bytes, "command_words", str.split)
    assert same_bytes.main(options()) == 2 and "make native" in capsys.readouterr().err
    monkeypatch.setattr(checkouts, "built", lambda tree: True)
    assert same_bytes.main(same_bytes.Options("nonsense")) == 2
    assert "has no commit nonsense" in capsys.readouterr().err
