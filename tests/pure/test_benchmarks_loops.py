"""The benchmarks of loops and of long runs: they start, judge loops rightly, and say what was measured."""

import importlib
import json
import mmap
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmark_results import laid_out
from sigmasplat.config.find_preset import preset
from sigmasplat.data import se3
from sigmasplat.errors import SourceError
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder

accuracy, long_run, loops, loops_tables, tables = map(
    importlib.import_module, ("accuracy", "long_run", "loops", "loops_tables", "tables")
)
ROOM = "synthetic:frames=40,width=32,height=24"


def loop(query: int, database: int, T: Any, accepted: bool = True, chi2: float | None = 3.0) -> dict[str, Any]:
    """Make the record of a loop as a run writes it."""
    numbers = {"similarity": 0.9, "residual": 0.02, "overlap": 0.5, "translation_m": 0.2, "rotation_deg": 1.0}
    frames = {"query_frame": 10 * query, "database_frame": 10 * database}
    matrix = {"T_query_database": np.asarray(T).tolist()}
    return {"query": query, "database": database, "accepted": accepted, "chi2": chi2} | frames | numbers | matrix


def test_a_loop_is_false_by_its_pose_against_the_true_one() -> None:
    for off, true in [
        ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], True),
        ([0.29, 0.0, 0.0, 0.0, 0.0, 0.0], True),
        ([0.0, -0.31, 0.0, 0.0, 0.0, 0.0], False),
        ([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(9.9)], True),
        ([0.0, 0.0, 0.0, np.radians(-10.1), 0.0, 0.0], False),
    ]:
        T_world_query, T_world_database = (
            se3.exp(np.array(xi)) for xi in ([3, 1, 0, 0, 0, 1.2], [2, 1, 1, 0.3, 0, 0.7])
        )
        T_query_database = se3.inverse(T_world_query) @ T_world_database @ se3.exp(np.array(off))
        record = loops.judged(loop(5, 1, T_query_database), T_world_query, T_world_database)
        assert record["true"] is true and "T_query_database" not in record
        assert record["error_m"] == pytest.approx(np.linalg.norm(off[:3]), abs=1e-4)
        assert record["error_deg"] == pytest.approx(np.degrees(np.linalg.norm(off[3:])), abs=1e-3)
        swapped = loops.judged(loop(5, 1, se3.inverse(T_query_database)), T_world_query, T_world_database)
        assert not swapped["true"], "T_b_a in place of T_a_b is no loop"


def run_with(folder: Path, tried: list[dict[str, Any]]) -> RunFolder:
    """Leave a run of ROOM in four submaps of ten frames, its third frame missing, and these loops."""
    source = open_source(ROOM)
    run = RunFolder.create(folder, preset("varsplat-fast"), source.name)
    for i in (i for i in range(40) if i != 2):
        run.log({"index": i, "timestamp_s": i / 30, "is_keyframe": i % 5 == 0, "submap": i // 10})
    (folder / "loops.json").write_text(json.dumps(tried))
    return run


def test_a_runs_loops_are_judged_by_the_first_frames_of_its_submaps(tmp_path: Path) -> None:
    truth = open_source(ROOM).truth().T_world_camera
    right = se3.inverse(truth[30]) @ truth[10]
    wrong = se3.inverse(truth[29]) @ truth[0]
    tried = [loop(3, 1, right), loop(3, 0, wrong), loop(2, 0, np.eye(4), False, None), loop(3, 0, wrong, False, 99.0)]
    found = loops.described(run_with(tmp_path / "run", tried), ROOM, True)
    assert (found["submaps"], found["tried"]) == (4, 4)
    assert [record["query"] for record in found["loops"]] == [3, 3, 3], "what was never registered has no pose"
    assert found["loops"][0]["error_m"] == pytest.approx(0, abs=1e-6)
    T_error = se3.inverse(se3.inverse(truth[30]) @ truth[0]) @ wrong
    assert found["loops"][1]["error_m"] == pytest.approx(np.linalg.norm(T_error[:3, 3]), abs=1e-4)
    assert loops.described(run_with(tmp_path / "other", tried), ROOM, False) == {"submaps": 4, "tried": 0, "loops": []}


def test_each_seed_has_a_room_of_its_own() -> None:
    listed = loops.jobs_of(loops.Options(seeds=(4, 7), real_seeds=(0,), settings=("mapping.iterations=5",)))
    assert [(experiment, way, job.seed) for experiment, way, job in listed] == [
        ("drift", "loops", 4), ("drift", "loops", 7), ("real", "loops", 0), ("real", "one submap", 0),
    ]  # fmt: skip
    configs = [job.key()["config"] for *_, job in listed]
    rules = ("distance_m", "frames", "uncertainty_m")
    assert [any(config["submaps"][rule] for rule in rules) for config in configs] == [True, True, True, False]
    assert {c["mapping"]["iterations"] for c in configs} == {5}
    assert [job.path.rpartition(",")[2] for *_, job in listed[:2]] == ["seed=4", "seed=7"]
    with pytest.raises(SourceError, match="give --seeds"):
        loops.checked(loops.Options(source=f"{ROOM},seed=1"))
    quick = loops.shortened(loops.Options())
    assert quick.experiments == ("drift",) and len(quick.seeds) == 1
    loops.checked(quick)


def job(
    experiment: str,
    way: str,
    seed: int,
    ate_m: float,
    without_m: float | None = None,
    found: list[tuple[bool, bool]] = (),  # type: ignore[assignment]
) -> dict[str, Any]:
    """Make a run's result; `found` says of each registered loop whether it was accepted and whether it is true."""
    records = [
        {**loop(9, 2, np.eye(4), accepted), "true": true, "error_m": 0.04, "error_deg": 1.0} for accepted, true in found
    ]
    rest = {"problem": None, "wall_s": 1.0, "peak_mib": 500.0, "submaps": 12, "tried": 20, "loops": records}
    source = "drift" if experiment == "drift" else "redkitchen"
    figures = {"ate_m": ate_m, "ate_odometry_m": without_m}
    return {"experiment": experiment, "source": source, "way": way, "seed": seed, "figures": figures, **rest}


def test_seeds_are_paired_and_loops_counted() -> None:
    jobs = [
        job("drift", "loops", 0, 0.05, 0.20, [(True, True), (True, True), (False, True), (False, False)]),
        job("drift", "loops", 1, 0.10, 0.40, [(True, True), (True, False)]),
        job("real", "loops", 0, 0.03, 0.04, [(True, True), (False, True)]),
        job("real", "one submap", 0, 0.031),
        {**job("drift", "loops", 2, 0.0), "problem": "a | b"},
    ]
    made = laid_out("loops", {"jobs": jobs})
    assert [row[1:5] for row in made["Seeds"].rows[:2]] == [
        ["0", "5.00", "20.0", "0.250"],
        ["1", "10.0", "40.0", "0.250"],
    ]
    assert [row[6:] for row in made["Seeds"].rows[:2]] == [
        ["20", "2", "2", "0", "1", "1"],
        ["20", "2", "1", "1", "0", "0"],
    ]
    assert len(made["Edges"].rows) == 1 and len(made["Runs"].rows) == 3 and len(made["Failed"].rows) == 1
    held = {row[0]: (row[1], row[3]) for row in made["Goals"].rows}
    assert list(held.values()) == [
        ("2, 1", "yes"), ("1", "**no**"), ("0.250", "yes"), ("0.250, 0.250", "yes"), ("3.00", "yes")
    ]  # fmt: skip


def test_goals_are_missed_without_loops_or_gain() -> None:
    jobs = [
        job("drift", "loops", 0, 0.05, 0.10, [(True, True)]),
        job("drift", "loops", 1, 0.09),
        job("real", "loops", 0, 0.04), job("real", "one submap", 0, 0.031),
    ]  # fmt: skip
    rows = laid_out("loops", {"jobs": jobs})["Goals"].rows
    assert [(row[1], row[3]) for row in rows] == [
        ("1, 0", "**no**"), ("0", "yes"), ("0.737", "**no**"), ("0.500, 1.00", "**no**"), ("4.00", "**no**")
    ]  # fmt: skip


def test_runs_are_made_and_described_seed_by_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def ran(jobs: list[Any], options: Any) -> list[dict[str, Any]]:
        for made in jobs[:1]:
            run_with(made.folder(options.runs) / "run", [])
        rest = {"wall_s": 1.0, "peak_mib": 1.0, "figures": {"ate_m": 0.1}}
        return [{"problem": "it broke" if made is jobs[1] else None, **rest} for made in jobs]

    monkeypatch.setattr(accuracy, "run_all", ran)
    options = loops.Options(experiments=("drift",), source=ROOM, seeds=(0, 1, 2), runs=tmp_path)
    found = loops.measure(options)
    assert [result["way"] for result in found] == ["loops"] * 3
    assert found[0]["problem"] is None and found[0]["submaps"] == 4
    assert found[1]["problem"] == "it broke" and found[2]["problem"].startswith("RunError: no run folder")


def test_quarters_are_summed_up_and_held_against_each_other() -> None:
    count = 2001
    quarter = np.repeat([0, 1, 2, 3], [501, 500, 500, 500])
    seconds = np.array([0.02, 0.040, 0.03, 0.043])[quarter]
    seconds[::100] += 1.0  # a cut now and then: the median does not see it
    memory = np.array([300.0, 400.0, 430.0, 470.0])[quarter]
    each = {"seconds": seconds.tolist(), "resident_mib": memory.tolist(), "submap": (np.arange(count) // 40).tolist()}
    rest = {"frames": count, "lost": 0, "submaps": 51, "loops_tried": 9, "loops_accepted": 4, "ate_m": 0.1}
    parts = long_run.quarters(each)
    assert [part["frames"] for part in parts] == [501, 500, 500, 500]
    assert [part["median_s"] for part in parts] == pytest.approx([0.02, 0.040, 0.03, 0.043])
    assert parts[1]["mean_s"] == pytest.approx(0.040 + 5 / 500) and parts[3]["submaps"] == 51
    figures = {"source": ROOM, "finish": {"finish_s": 3.0, "resident_mib": 600.0}, "each": each, **rest}
    made = laid_out("long_run", figures)
    assert len(made["Quarters"].rows) == 4
    assert [row[3] for row in made["Goals"].rows] == ["yes", "yes", "yes", "**no**"]  # 1.075, 1.06, 1.175
    short = replace_frames(figures, 1000)
    assert laid_out("long_run", short)["Goals"].rows[0][3] == "**no**"


def replace_frames(figures: dict[str, Any], count: int) -> dict[str, Any]:
    """Cut the figures of a run down to so many frames."""
    return figures | {"frames": count, "each": {name: values[:count] for name, values in figures["each"].items()}}


def test_drawn_frames_are_the_sources_own(tmp_path: Path) -> None:
    path = f"{ROOM},noise=1"
    long_run.draw(path, tmp_path, range(0, 40, 13))
    source, drawn = open_source(path), long_run.Drawn(open_source(path), tmp_path)
    for i in (0, 13, 39):
        ours, theirs = drawn.frame(i), source.frame(i)
        assert ours.color.tobytes() == theirs.color.tobytes() and ours.depth_m.tobytes() == theirs.depth_m.tobytes()
        assert (ours.index, ours.timestamp_s, ours.camera) == (theirs.index, theirs.timestamp_s, theirs.camera)
    assert len(drawn) == 40 and np.array_equal(drawn.truth().T_world_camera, source.truth().T_world_camera)


def test_memory_that_is_taken_is_seen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    before = long_run.resident_mib()
    taken = mmap.mmap(-1, 64 << 20)  # pages of its own: an array might be given memory that was freed before
    np.frombuffer(taken, np.uint8)[:: mmap.PAGESIZE] = 1
    assert long_run.resident_mib() - before == pytest.approx(64, abs=8)
    monkeypatch.setattr(long_run, "STATM", tmp_path / "none")
    with pytest.raises(SourceError, match="which this system does not have"):
        long_run.resident_mib()


def test_every_step_is_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A stand-in for SLAM that knows the truth: times, submaps and ATE come back as it gave them."""
    (tmp_path / "frames").mkdir()
    long_run.draw(ROOM, tmp_path / "frames", range(40))
    truth = open_source(ROOM).truth()

    class Stand:
        loops = (SimpleNamespace(accepted=True), SimpleNamespace(accepted=False))

        def __init__(self, config: Any, store: Any) -> None:
            assert store.folder == tmp_path / "submaps"

        def step(self, frame: Any) -> Any:
            return SimpleNamespace(
                seconds={"total": 0.01 * frame.index}, submap=frame.index // 9, lost=frame.index == 3
            )

        def trajectory(self) -> Any:
            return replace(truth)

        def finish(self) -> None:
            finished.append(True)

    finished: list[bool] = []
    monkeypatch.setattr("sigmasplat.system.slam.Slam", Stand)
    found = long_run.follow(ROOM, tmp_path, preset("varsplat-fast"), True)
    assert finished == [True] and found["each"]["seconds"] == [round(0.01 * i, 6) for i in range(40)]
    assert (found["frames"], found["lost"], found["submaps"]) == (40, 1, 5)
    assert (found["loops_tried"], found["loops_accepted"]) == (2, 1)
    assert found["ate_m"] == pytest.approx(0, abs=1e-9) and min(found["each"]["resident_mib"]) > 10
    assert long_run.follow(ROOM, tmp_path, preset("varsplat-fast"), False)["finish"] is None
