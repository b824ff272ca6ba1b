"""Bad sequences on the command line, end to end: one line, exit code 2, nothing written, nothing deleted."""

import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from command_line import exit_code
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.run_folder.runs import RunFolder

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

SETTINGS = ("input.width=32", "mapping.first_iterations=3", "mapping.iterations=2", "final.iterations=2")
QUICK = [word for setting in SETTINGS for word in ("--set", setting)]


def contents(folder: Path) -> dict[str, str]:
    """Return a digest of every file below a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def refused(tiny_tum: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must be refused and return its message. It must not write any file or change the sequence."""
    place = tiny_tum.parent
    monkeypatch.chdir(place)

    def run(*arguments: str) -> str:
        before = contents(place)
        assert exit_code("run", *arguments) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.startswith("sigmasplat: ") and said.err.count("\n") == 1, said
        assert contents(place) == before and not (place / "runs").exists()
        return said.err

    return run


def no_depth_list(folder: Path) -> None:
    (folder / "depth.txt").unlink()


def no_depth_files(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        path.unlink()


def blank_depth(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        Image.fromarray(np.zeros((24, 32), np.uint16)).save(path)


def half_size_depth(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        Image.fromarray(np.full((12, 16), 2000, np.uint16)).save(path)


def later_depth(folder: Path) -> None:
    (folder / "depth.txt").write_text("".join(f"{100 + i} depth/{i}.png\n" for i in range(4)))


def pose_line(line: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "groundtruth.txt").write_text(f"0.0 0 0 0 0 0 0 1\n{line}\n")


def no_lists(folder: Path) -> None:
    for part in ("rgb", "depth"):
        (folder / f"{part}.txt").unlink()
        (folder / part).rename(folder / f"z_{part[::-1]}")


DAMAGE: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "unknown format": (no_lists, ("unknown format", "TUM, ", "Replica, ", "found calibration.json")),
    "no depth list": (no_depth_list, ("no depth images in", "looked for depth.txt", "RGB-only")),
    "no depth files": (no_depth_files, ("no depth images in", "the 4 files of depth.txt", "RGB-only")),
    "blank depth": (blank_depth, ("depth is zero or unreadable in all 4 frames", "check the depth files")),
    "sizes differ": (half_size_depth, ("is 32×24 but", "is 16×12", "register depth to colour")),
    "no overlap in time": (later_depth, ("0.000 … 0.300 s", "100.000 … 103.000 s", "one recording?")),
    "pose not finite": (pose_line("0.1 nan 0 0 0 0 0 1"), ("groundtruth.txt:2", "not finite", "delete the line")),
    "pose not rigid": (pose_line("0.1 0 0 0 0 0 0 2"), ("groundtruth.txt:2", "not rigid", "length 2")),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_bad_sequence_is_refused_before_anything_is_written(
    name: str, refused: Callable[..., str], tiny_tum: Path
) -> None:
    damage, says = DAMAGE[name]
    damage(tiny_tum)
    line = refused(str(tiny_tum), *QUICK)
    for words in says:
        assert words in line


def test_a_missing_folder_is_refused(refused: Callable[..., str], tiny_tum: Path) -> None:
    assert f"no such folder or file: {tiny_tum}x; give a recording" in refused(f"{tiny_tum}x")
    assert "is a file of unknown format" in refused(str(tiny_tum / "rgb.txt"))


def test_a_replica_pose_that_is_not_rigid_is_refused(refused: Callable[..., str], tiny_tum: Path) -> None:
    results = tiny_tum.parent / "replica" / "results"
    results.mkdir(parents=True)
    for i in range(2):
        Image.fromarray(np.full((24, 32, 3), 90, np.uint8)).save(results / f"frame{i:06d}.jpg")
        Image.fromarray(np.full((24, 32), 6553, np.uint16)).save(results / f"depth{i:06d}.png")
    camera = {"w": 32, "h": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5, "scale": 6553.5}
    (results.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    for bad in ("nan", "2"):
        poses = ["1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", f"{bad} 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"]
        (results.parent / "traj.txt").write_text("\n".join(poses) + "\n")
        line = refused(str(results.parent), *QUICK)
        assert "traj.txt:2" in line and ("not finite" in line or "not a rigid camera-to-world pose" in line)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:60])


@pytest.mark.parametrize("part", ["rgb", "depth"])
def test_a_truncated_image_is_skipped_and_counted(
    part: str, tiny_tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truncate(tiny_tum / part / "2.png")
    assert exit_code("run", str(tiny_tum), "--out", str(tmp_path / "run"), *QUICK) == 0
    err = capsys.readouterr().err
    assert err.count("1 image skipped") == 1 and f"{part}/2.png" in err and "Traceback" not in err
    run = RunFolder.open(tmp_path / "run")
    assert [record["index"] for record in run.read_log()] == [0, 1, 3]
    skipped = run.facts()["skipped"]
    assert len(skipped) == 1 and f"{part}/2.png" in skipped[0] and run.read_metrics()["skipped"] == skipped


def test_strict_stops_at_a_truncated_image_and_keeps_the_results(
    tiny_tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truncate(tiny_tum / "rgb/2.png")
    assert exit_code("run", str(tiny_tum), "--strict", "--out", str(tmp_path / "run"), *QUICK) == 2
    err = capsys.readouterr().err
    refusal = [line for line in err.splitlines() if line.startswith("sigmasplat: ")]
    assert len(refusal) == 1 and "rgb/2.png: unreadable image" in refusal[0] and "Traceback" not in err
    run = RunFolder.open(tmp_path / "run")
    assert run.facts()["status"] == "failed"
    valid = [line for line in run.read_log() if not line["lost"]]
    assert len(run.read_log()) == 2 and len(run.read_map()) > 0
    assert len(run.read_trajectory()) == len(valid) >= 1


def scaled(folder: Path, units_per_metre: float) -> None:
    fields = json.loads((folder / "calibration.json").read_text()) | {"depth_scale": units_per_metre}
    (folder / "calibration.json").write_text(json.dumps(fields))


def test_the_warning_of_a_wrong_depth_unit_has_the_median(
    tiny_tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files are in millimetres; 16 cm is too small for a room but within the depth range of mapping."""
    scaled(tiny_tum, 12_500.0)
    assert exit_code("run", str(tiny_tum), "--no-eval", "--out", str(tmp_path / "run"), *QUICK) == 0
    err = capsys.readouterr().err
    (warning,) = [line for line in err.splitlines() if line.startswith("warning: ")]
    assert "median depth is 0.16 m over 4 frames" in warning
    assert "--depth-scale 1000 (millimetres) would make it 2.00 m" in warning
    assert RunFolder.open(tmp_path / "run").facts()["status"] == "complete"


def test_a_depth_unit_without_usable_depth_is_refused_after_a_warning(
    tiny_tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scaled(tiny_tum, 1.0)
    assert exit_code("run", str(tiny_tum), "--out", str(tmp_path / "run"), *QUICK) == 2
    warning, refusal = [line for line in capsys.readouterr().err.splitlines() if ": " in line[:13]]
    assert warning.startswith("warning: ") and "median depth is 2000 m" in warning
    assert refusal.startswith("sigmasplat: frame 0 has no depth reading") and "check the depth scale" in refusal
    assert not (tmp_path / "run").exists(), "the run has no results"


def test_truth_of_another_time_is_reported_after_all_results_are_written(
    tiny_tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tiny_tum / "groundtruth.txt").write_text("".join(f"{500 + i} {i} 0 0 0 0 0 1\n" for i in range(4)))
    assert exit_code("run", str(tiny_tum), "--out", str(tmp_path / "run"), *QUICK) == 2
    err = capsys.readouterr().err
    assert err.count("sigmasplat: estimate and truth share no timestamps") == 1 and "Traceback" not in err
    run = RunFolder.open(tmp_path / "run")
    assert run.facts()["status"] == "complete" and run.read_metrics()["ate"] is None
    assert (run.path / "report.html").stat().st_size > 1000


# ---- output folder


def test_an_earlier_run_is_replaced_only_with_overwrite(
    tiny_tum: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    command = ["run", str(tiny_tum), "--out", str(out), "--no-eval", *QUICK]
    assert exit_code(*command) == 0
    (out / "notes.txt").write_text("mine")
    before = contents(out)
    capsys.readouterr()
    assert exit_code(*command) == 2
    err = capsys.readouterr().err
    assert err.startswith("sigmasplat: output") and "exists and is not empty" in err and err.count("\n") == 1
    assert contents(out) == before
    assert exit_code(*command, "--overwrite", "--limit", "2") == 0
    assert len(RunFolder.open(out).read_log()) == 2 and (out / "notes.txt").read_text() == "mine"


def test_a_refused_sequence_does_not_delete_the_earlier_run(tiny_tum: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = ["run", str(tiny_tum), "--out", str(out), "--no-eval", *QUICK]
    assert exit_code(*command) == 0
    before = contents(out)
    half_size_depth(tiny_tum)
    assert exit_code(*command, "--overwrite") == 2
    assert contents(out) == before


def test_without_out_an_existing_name_gets_a_number(tiny_tum: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tiny_tum.parent)
    for _ in range(2):
        assert exit_code("run", str(tiny_tum), "--limit", "1", "--no-eval", *QUICK) == 0
    assert sorted(path.name for path in Path("runs").iterdir()) == ["tiny-sigma", "tiny-sigma-2"]


@pytest.mark.parametrize("place", ["file", "below a file", "below proc"])
def test_output_that_cannot_be_written_is_refused(place: str, refused: Callable[..., str], tiny_tum: Path) -> None:
    list_file = tiny_tum / "rgb.txt"
    out = {"file": list_file, "below a file": list_file / "run", "below proc": Path("/proc/sigmasplat/run")}[place]
    line = refused(str(tiny_tum), "--out", str(out), *QUICK)
    assert str(out) in line and ("give a folder" in line or "cannot write" in line)


def test_the_undamaged_sequence_runs(tiny_tum: Path, tmp_path: Path) -> None:
    """Without this, the refusals above would prove nothing."""
    assert exit_code("run", str(tiny_tum), "--strict", "--no-eval", "--out", str(tmp_path / "run"), *QUICK) == 0
    run = RunFolder.open(tmp_path / "run")
    assert isinstance(run.read_trajectory(), Trajectory) and run.facts()["skipped"] == []
