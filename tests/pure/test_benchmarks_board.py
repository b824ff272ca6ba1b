"""benchmarks/board.py: what is compared, what is kept by commit, what is left out, what counts as better or worse."""

import importlib
import json
import os
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.errors import ConfigError

board, code, runs, scores, tables, record = map(
    importlib.import_module,
    ("board", "board_code", "board_runs", "board_scores", "board_tables", "record"),
)
GOOD: dict[str, Any] = {
    "problem": None, "frames": 100, "ate_m": 0.02, "hops_m": 0.004, "windows_m": 0.01, "windows_k": 2.0, "lost": 0,
    "silent": 3, "psnr_db": 25.0, "depth_l1_m": 0.02, "cpu_s": 0.1, "unread": [],
}  # fmt: skip
ROOM = runs.Row("room", "synthetic:frames=4,width=64,height=48")


def row(name: str, of: str = "now", seed: int = 0, **changes: Any) -> dict[str, Any]:
    """Return a row of the results."""
    return {"code": of, "name": name, "seed": seed, **GOOD, **changes}


def table(rows: list[dict[str, Any]], left_out: tuple[str, ...] = (), **more: Any) -> Any:
    """Return the board of some rows."""
    codes = [{"name": name, "commit": 40 * "a", "digest": "b"} for name in ("now", "before")]
    figures = {"rows": rows, "left_out": [*left_out], "codes": codes, "runs_made": 1, "duration_s": 2.0}
    return laid_out("board", figures | more)


@pytest.fixture(autouse=True)
def no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge by the floors of the noise alone, whatever spread was measured."""
    monkeypatch.setattr(record, "latest", lambda *_: None)


# ---- rows and options ----


def test_the_board_has_the_rows_of_the_issue_and_unknown_ones_are_refused(tmp_path: Path) -> None:
    plain = [each.source for each in board.ROWS if not each.disturbance]
    assert plain[:6] == ["fr1_xyz", "livingroom", "redkitchen", "hololens", "cubicles", "cabinet58"]
    assert "noise=1" in plain[6] and plain[7:] == ["synthetic:corridor"]
    assert len({each.disturbance for each in board.ROWS}) == 5 and len(board.ROWS) == 12
    assert runs.named(("cubicles",), board.ROWS) == [board.ROWS[4]]
    with pytest.raises(ConfigError, match=r"no row 'kitchen'; there are 'fr1_xyz', "):
        runs.named(("kitchen",), board.ROWS)
    assert board.main(board.Options(rows=("kitchen",), cache=tmp_path, out=tmp_path)) == 2


def test_the_revision_is_the_only_word_without_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    program = importlib.import_module("program")
    seen: list[Any] = []
    monkeypatch.setattr(program.record, "refuse_unwritable", lambda _: None)
    for words in ([], ["HEAD~3", "--seeds", "0", "1"]):
        monkeypatch.setattr(sys, "argv", ["board.py", *words])
        with pytest.raises(SystemExit):
            program.start(lambda options: seen.append(options) or 0, board.Options)
    assert [(options.before, options.seeds) for options in seen] == [("", (0,)), ("HEAD~3", (0, 1))]


@pytest.mark.parametrize(("problem", "code"), [(None, 0), ("it failed", 1)])
def test_only_a_failed_run_makes_a_program_fail_not_what_was_left_out(
    monkeypatch: pytest.MonkeyPatch, problem: str | None, code: int
) -> None:
    program = importlib.import_module("program")
    monkeypatch.setattr(program, "keep", lambda *_, **__: {})
    monkeypatch.setattr(program.tables, "table", lambda _: "")
    figures = {"runs": [{"problem": problem}], "left_out": ["missing: gone"]}
    assert program.run("board", None, lambda _: figures) == code


def test_rows_without_a_recording_or_too_short_are_left_out_and_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    room = "synthetic:frames=40,width=64,height=48"
    rows = (
        ROOM, runs.Row("missing", str(tmp_path / "missing")), runs.Row("short", room, "black", 3, frames=40),
        runs.Row("long enough", room, "black", 1, frames=30),
    )  # fmt: skip
    monkeypatch.setattr(board, "ROWS", rows)
    kept, left_out = board.possible(tuple(each.name for each in rows))
    assert [each.name for each in kept] == ["room", "long enough"]
    assert left_out[0].startswith("missing: ") and left_out[1].startswith("short: 40 frames are too few for black")
    assert "Left out: missing: gone." in table([row("room")], ("missing: gone",))["Board"].note


# ---- verdicts ----


@pytest.mark.parametrize(("figure", "now", "verdict"), [
    ("ate_m", 0.0195, ""), ("ate_m", 0.017, "better"), ("ate_m", 0.025, "worse"),
    ("psnr_db", 25.05, ""), ("psnr_db", 25.3, "better"), ("psnr_db", 24.5, "worse"),
    ("windows_k", 1.8, ""), ("windows_k", 0.9, "better"), ("windows_k", 4.0, "worse"), ("windows_k", 0.2, "worse"),
    ("silent", 2, ""), ("silent", 1, "better"), ("lost", 5, "worse"),
    ("cpu_s", 0.105, ""), ("cpu_s", 0.08, "better"), ("cpu_s", 0.12, "worse"),
])  # fmt: skip
def test_differences_beyond_the_noise_are_marked(figure: str, now: float, verdict: str) -> None:
    made = table([row("room", **{figure: now}), row("room", "before")])["Board"]
    at = 2 + list(tables.QUANTITIES).index(figure)
    (cells,) = made.rows
    assert cells[at].endswith(f"**{verdict}**" if verdict else cells[at].rpartition(" ")[2]) and " → " in cells[at]
    others = [cell for i, cell in enumerate(cells) if i not in (0, at)]
    assert not any("→" in cell or "**" in cell for cell in others)
    for name in ("better", "worse"):
        wanted = f"room: {tables.QUANTITIES[figure].heading.split(',')[0]}" if name == verdict else "nothing"
        assert f"{name}: {wanted}." in made.note


def test_the_spread_of_seeds_widens_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = [row("room", ate_m=0.03), row("room", "before"), row("hall", ate_m=0.03), row("hall", "before")]
    measured = [row("room", seed=0, ate_m=0.01), row("room", seed=1, ate_m=0.02), row("hall")]
    assert tables.seeds_spread(measured)["room", "ate_m"] == pytest.approx(0.01 / 2**0.5)
    assert ("hall", "ate_m") not in tables.seeds_spread(measured)
    monkeypatch.setattr(record, "latest", {tables.NOISE: {"figures": {"rows": measured}}}.get)
    assert [cells[2] for cells in table(compared)["Board"].rows] == ["2.00 → 3.00", "2.00 → 3.00 **worse**"]


def test_a_figure_on_one_side_only_has_no_verdict_and_a_failed_row_is_listed() -> None:
    half = row("room", ate_m=None, unread=["submaps: other format"])
    made = table([half, row("room", "before"), row("hall", problem="gone")])
    (cells,), note = made["Board"].rows, made["Board"].note
    assert cells[2] == "2.00 → –" and "better: nothing. worse: nothing." in note
    assert "Not read: room, now: submaps: other format." in note
    assert list(made["Failed"].rows) == [["hall, now, seed 0", "gone"]]


def test_rows_that_are_worse_than_the_plain_system_are_marked() -> None:
    names = ("room", "hall", "attic")
    assert "plain" not in table([row("room")])["Board"].note
    plain = dict(zip(names, ({"ate_m": 0.015}, {"ate_m": 0.0199}, {"problem": "gone"}), strict=True))
    made = table([row(name) for name in names], plain=plain)["Board"]
    assert made.columns[2:5] == ["ATE, cm", "plain system", "hops, mm"]
    assert [cells[3] for cells in made.rows] == ["1.50 **ours is worse**", "1.99", "–"]
    assert "worse than the plain system: room." in made.note and "better: " not in made.note


# ---- results kept by commit ----


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a repository of two commits, of which the last one changes a document only."""
    root = tmp_path / "checkout"
    (root / "src" / "sigmasplat").mkdir(parents=True)
    monkeypatch.setattr(record, "ROOT", root)
    subprocess.run(["git", "init", "-q", str(root)], check=True)
    for key, value in (("user.name", "T"), ("user.email", "t@example.org")):
        code.git("config", key, value)
    (root / "src" / "sigmasplat" / "__init__.py").write_text("")
    for name in ("CMakeLists.txt", "notes.md"):
        (root / name).write_text("first")
        code.git("add", ".")
        code.git("commit", "-qm", name)
    return root


def test_equal_sources_have_one_digest_and_changed_ones_another(checkout: Path) -> None:
    now, before = code.current(), code.revision("HEAD")
    assert (now.name, before.name) == ("now", "before") and now.digest == before.digest and now.commit == before.commit
    (checkout / "notes.md").write_text("second")
    assert code.current() == now
    code.git("commit", "-qam", "notes")
    assert code.current().digest == code.revision("HEAD~1").digest and code.current().commit != now.commit
    (checkout / "src" / "sigmasplat" / "new.py").write_text("x = 1")
    changed = code.current().digest
    assert changed.startswith("changed") and changed != now.digest
    code.git("add", ".")
    code.git("commit", "-qm", "new")
    assert not code.current().digest.startswith("changed") and code.current().digest != now.digest
    with pytest.raises(ConfigError, match=r"git rev-parse --verify: "):
        code.revision("nowhere")


def test_results_are_kept_by_commit_row_and_seed(checkout: Path, tmp_path: Path) -> None:
    kept = code.Kept.of(code.current(), tmp_path / "kept")
    assert kept.found(ROOM, 0) is None
    kept.keep(ROOM, 0, GOOD)
    kept.keep(ROOM, 1, {"problem": "failed"})
    code.git("commit", "-q", "--allow-empty", "-m", "later")
    again = code.Kept.of(code.revision("HEAD"), tmp_path / "kept")
    assert again.found(ROOM, 0) == GOOD and again.found(ROOM, 1) is None and again.found(ROOM, 2) is None
    assert again.found(replace(ROOM, limit=3), 0) is None  # another row of the same name
    other = replace(code.current(), digest="0123456789ab")
    assert code.Kept.of(other, tmp_path / "kept").found(ROOM, 0) is None


def test_only_new_code_is_run(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[str, int]] = []

    def run_all(tasks: list[Any], kept: dict[Any, Any]) -> None:
        for task in tasks:
            made.append((task.code.name, task.seed))
            kept[task.code].keep(task.row, task.seed, GOOD)

    monkeypatch.setattr(board, "run_all", run_all)
    monkeypatch.setattr(board, "ROWS", (ROOM,))
    options = board.Options(rows=("room",), cache=tmp_path / "kept")
    assert [found["code"] for found in board.measure(options)["rows"]] == ["now"]
    (checkout / "src" / "sigmasplat" / "new.py").write_text("x = 1")
    assert board.measure(replace(options, before="HEAD"))["runs_made"] == 1
    assert board.measure(replace(options, seeds=(0, 1)))["runs_made"] == 1
    assert made == [("now", 0), ("plain", 0), ("now", 0), ("now", 1)]  # the plain system runs once
    measured = board.measure(replace(options, fresh=True))
    assert measured["runs_made"] == 2 and measured["plain"]["room"]["ate_m"] == GOOD["ate_m"]
    assert [each["name"] for each in measured["codes"]] == ["now", "plain"]


def test_a_commit_runs_in_a_worktree_with_its_own_package(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(code, "compile_kernels", lambda _: None)
    native = checkout / "src" / "sigmasplat" / "native"
    native.mkdir()
    (native / "kernel.cpp").write_text("// 1")
    code.git("add", ".")
    code.git("commit", "-qm", "kernel")
    (native / "_core.test.so").write_text("compiled")
    with ExitStack() as stack:
        found = code.revision("HEAD").ready(stack, tmp_path)
        assert (found / "src/sigmasplat/native/_core.test.so").read_text() == "compiled" and code.kernels_of(found)
        assert code.environment(found)["PYTHONPATH"] == str(found / "src")
    assert not found.exists() and code.git("worktree", "list").count("\n") == 0
    (native / "kernel.cpp").write_text("// 2")
    for age_s, usable in ((-10, False), (10, True)):  # older than its source, or newer
        time_s = (native / "kernel.cpp").stat().st_mtime + age_s
        os.utime(native / "_core.test.so", (time_s, time_s))
        assert bool(code.kernels_of(checkout)) == usable
        with ExitStack() as stack:  # the kernel of the commit differs from the compiled one
            assert not list(code.revision("HEAD").ready(stack, tmp_path).rglob("*.so"))
    with pytest.raises(ConfigError, match=r"Python does not import the package in .*nothing/src but "):
        code.refuse_other_package(tmp_path / "nothing")


# ---- figures ----


def test_the_error_of_motions_needs_both_ends_only() -> None:
    true = np.tile(np.eye(4), (6, 1, 1))
    true[:, 0, 3] = np.arange(6)
    wrong = true.copy()
    wrong[4:, 1, 3] = 0.3
    every, some = np.arange(6), np.array([0, 1, 3, 4, 5])
    assert scores.motion_error_m(every, wrong, true, 1) == pytest.approx(0.3 / 5**0.5)
    assert scores.motion_error_m(some, wrong[some], true[some], 1) == pytest.approx(0.3 / 3**0.5)
    assert scores.motion_error_m(every, wrong, true, 3) == pytest.approx(0.3 * (2 / 3) ** 0.5)
    assert scores.motion_error_m(every, wrong, true, 6) is None


def test_settings_of_another_version_are_read_as_far_as_they_are_known() -> None:
    config = scores.known_settings({"input": {"width": 200, "of_old": 1}, "old": {"x": 1}, "mapping": {"old": 2}})
    assert config.input.width == 200 and config.render == scores.known_settings({}).render


def test_the_clock_counts_from_the_first_frame_to_the_last(tmp_path: Path) -> None:
    work = """
import sys, time
def spin(s):
    end = time.process_time() + s
    while time.process_time() < end: pass
spin(0.3)
with open(sys.argv[1], "w") as log:
    for _ in range(6):
        log.write("{}\\n"); log.flush(); spin(0.1)
    log.write("{}\\n"); log.flush(); time.sleep(0.2)
spin(0.3)
"""
    log = tmp_path / "log.jsonl"
    process = subprocess.Popen([sys.executable, "-c", work, str(log)])
    assert runs.frame_seconds(process, log) == pytest.approx(0.1, rel=0.3)
    assert process.returncode == 0 and runs.processor_seconds(process.pid) is None


def test_a_run_that_fails_is_a_problem_with_its_last_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho first; echo 'the last line' >&2; exit 2\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    (tmp_path / "scratch").mkdir()
    failed = runs.perform(ROOM, 0, record.ROOT, tmp_path / "scratch")
    assert failed["problem"] == "ValueError: the last line" and failed["wall_s"] >= 0
    gone = runs.perform(replace(ROOM, source="nothing-here", disturbance="clean"), 0, record.ROOT, tmp_path / "scratch")
    assert "nothing-here" in gone["problem"] and not list((tmp_path / "scratch").iterdir())


@pytest.mark.parametrize("disturbed", [False, True])
def test_the_plain_system_runs_any_row_without_a_checkout(disturbed: bool, tmp_path: Path) -> None:
    how: dict[str, Any] = {"disturbance": "clean", "severity": 1, "frames": 3} if disturbed else {}
    walk = replace(ROOM, source="synthetic:frames=200,width=64,height=48", limit=4, **how)
    assert code.Code("plain", "", "").ready(ExitStack(), tmp_path) is None
    found = runs.perform(walk, 0, None, tmp_path)
    assert found["problem"] is None and found["frames"] == (3 if disturbed else 4) and 0 < found["ate_m"] < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("disturbed", [False, True])
def test_a_row_is_run_and_scored(disturbed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "environment", lambda _: {**os.environ, **runs.ONE_THREAD})  # the installed package
    how: dict[str, Any] = {"disturbance": "clean", "severity": 1, "frames": 3} if disturbed else {}
    walk = replace(ROOM, source="synthetic:frames=200,width=64,height=48", limit=4, **how)
    found = runs.perform(walk, 0, record.ROOT, tmp_path)
    assert found["problem"] is None and found["frames"] == (3 if disturbed else 4), found["problem"]
    assert found["lost"] == found["silent"] == 0 and 0 < found["ate_m"] < 0.02
    assert json.dumps(found, allow_nan=False) and not list(tmp_path.iterdir())
    if not disturbed:
        assert found["windows_m"] is None and found["unread"] == []
        assert found["psnr_db"] > 15 and 0 < found["depth_l1_m"] < 0.2 and 0 < found["hops_m"] < 0.02
