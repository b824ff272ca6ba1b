"""`sigmasplat calibrate`: the times of a sensor from a recording, and runs that begin with them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from command_line import exit_code
from late_images import CAMERA, film, path
from sigmasplat.config import InputConfig
from sigmasplat.config.find_preset import configured
from sigmasplat.data import se3
from sigmasplat.data.readout import UNKNOWN_TIMES, Readout, SensorTimes
from sigmasplat.errors import ConfigError
from sigmasplat.plugins.sources.tum import TumWriter
from sigmasplat.render.render import render
from sigmasplat.run.calibrate import WITHOUT_MAP
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam
from sigmasplat.types import completed

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

Array = NDArray[np.float64]
LATE_S, DEPTH_ROWS_S, COLOR_ROWS_S = TIMES_S = (-0.015, 0.025, 0.03)
QUICK = ("--set", "final.iterations=0", "--set", "uncertainty.probes=0", "--set", "input.width=80")


def record(folder: Path, frames: int, times_s: tuple[float, float, float]) -> Path:
    """Write the film of a hand that shakes."""
    writer = TumWriter(folder, CAMERA)
    for seen in film(frames, times_s):
        writer.add(seen)
    return folder


def test_times_are_found_and_a_run_uses_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen, file, run = record(tmp_path / "shaken", 64, TIMES_S), tmp_path / "times.json", tmp_path / "run"
    assert exit_code("calibrate", str(seen), "--out", str(file)) == 0
    times = SensorTimes.noted_in(json.loads(file.read_text()))
    found = np.array([times.depth_late_s, times.depth_rows_s, times.color_rows_s])
    assert times.std_s is not None and max(times.std_s) < 0.002 and np.abs(found - TIMES_S).max() < 0.002
    said = capsys.readouterr().out
    assert times.said() in said and f"sigmasplat run {seen} --set input.calibrate={file}" in said
    assert Image.open(tmp_path / "times.png").width > 900

    limited = ("run", str(seen), "--limit", "8", "--out", str(run))
    assert exit_code(*limited, "--set", f"input.calibrate={file}", *QUICK) == 0
    assert times.said() in capsys.readouterr().out
    folder = RunFolder.open(run)
    assert SensorTimes.noted_in(folder.facts()).said() == times.said() in (run / "report.html").read_text()
    file.unlink()
    assert Slam(folder.config()).sensor_times == Slam(settings={"input.calibrate": str(run / "run.json")}).sensor_times
    assert Slam(folder.config()).tracker.times.depth_late_s == pytest.approx(times.depth_late_s, abs=1e-6)


def test_keyframes_have_moved_as_the_frames_before_and_after_them_say() -> None:
    """Those that two submaps share, too. The motion since the frame before is off by up to 0.04 rad/s."""
    slam = Slam(configured(None, {"submaps.frames": 6, "input.width": 160}).changed(**WITHOUT_MAP))
    for seen in film(24, (0.0, 0.0, 0.0)):
        slam.step(seen)
    completed(slam.finish_submap())
    slam.correct_motions()
    rows, every = slam.atlas.T_world_keyframes, slam.atlas.T_world_camera()
    frames = np.array([np.abs(every - T).sum((1, 2)).argmin() for T in rows])
    assert len(slam.atlas.anchors) > 2 and len(set(frames.tolist())) < len(rows)
    inner = np.flatnonzero((frames > 0) & (frames < 23))
    true = se3.rates(path(np.arange(24) / 30), np.arange(24) / 30, frames[inner], np.ones(24, bool))
    found = np.array([slam.atlas.readings[row].rate for row in inner])
    assert np.abs(found - true)[:, 3:].max() < 0.02 < np.abs(true[:, 3:]).max() / 5


def test_a_wrong_scale_of_depth_moves_a_pose_as_its_covariance_says() -> None:
    """While frames arrive, too: the camera's errors are the same in all hops. Rendered images do not have them."""

    def followed(scale: float, sensor: str) -> Slam:
        slam = Slam(configured(None, {"input.width": 160, "input.sensor": sensor}).changed(**WITHOUT_MAP))
        for seen in film(24, (0.0, 0.0, 0.0)):
            slam.step(replace(seen, depth_m=seen.depth_m * np.float32(scale)))
        return slam

    stated, wrong, rendered = followed(1.0, "auto"), followed(1.01, "auto"), followed(1.0, "rendered")
    (T, moved), hops = (slam.atlas.keyframe_poses.last for slam in (stated, wrong)), stated.atlas.hops
    assert len(T) == len(moved) > 4
    twist = -sum(se3.adjoint(T[k]) @ hops[k].camera[:, 0] for k in range(1, len(T)))
    np.testing.assert_allclose((se3.displacement(T[-1]) @ twist)[:3], (moved[-1] - T[-1])[:3, 3], rtol=0.01)
    off = (wrong.trajectory().T_world_camera - stated.trajectory().T_world_camera)[-1, :3, 3]
    whole, without = (float(off @ np.linalg.solve(s.covariance()[:3, :3], off)) for s in (stated, rendered))
    assert 0.3 < whole < 1.1 and without > 4.0


def test_once_the_times_are_known_what_was_mapped_before_is_mapped_again() -> None:
    """All keyframes of the submap move and are seeded anew: those mapped as if read at once were off by 19 mm."""
    slam = Slam(configured(None, {"input.width": 160}))
    for seen in film(100, TIMES_S):
        slam.step(seen)
        if slam.graph.times.std_s is not None:
            break
    keyframes = slam.mapper.keyframes
    frames = [keyframe.index for keyframe in keyframes]
    at_once = list(film(frames[-1] + 1, (0.0, 0.0, 0.0)))
    assert frames[0] == 0 and 15 < len(frames) < 25 and slam.mapper.pending > 100
    completed(slam.refining(slam.mapper.pending))
    true = se3.inverse(path(np.zeros(1))) @ path(np.array(frames) / 30)
    assert np.abs(np.stack([keyframe.T_world_camera for keyframe in keyframes]) - true)[:, :3, 3].max() < 0.001
    shown = [render(slam.field, CAMERA, se3.inverse(keyframe.T_world_camera)).color for keyframe in keyframes]
    squares = [((np.asarray(s) - at_once[i].color) ** 2).mean() for s, i in zip(shown, frames, strict=True)]
    assert -10.0 * np.log10(squares).mean() > 44.5  # 43.3 if nothing is done again


@pytest.mark.parametrize("depth", ["predicted=1", "stereo=10"])
def test_computed_depth_has_no_times_of_its_own(depth: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = f"synthetic:frames=3,width=96,height=72,{depth}"
    assert exit_code("calibrate", source, "--out", str(tmp_path / "times.json")) == 2
    assert "calibrate a recording of a sensor" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_a_camera_at_rest_shows_no_times(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still, file = record(tmp_path / "still", 1, (0.0, 0.0, 0.0)), tmp_path / "times.json"
    assert exit_code("calibrate", str(still), "--out", str(file)) == 2
    assert "still: 0 pairs of keyframes do not show clearly when the sensor reads; record" in capsys.readouterr().err
    assert not file.exists()


@pytest.mark.parametrize(
    ("name", "out", "message"),
    [("a.json", "a.json", "a.json exists and was not written by this command; give another --out"),
     ("a.png", "a", "a.png exists and was not written by this command; give another --out")],
)  # fmt: skip
def test_other_files_are_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, out: str, message: str
) -> None:
    (tmp_path / name).write_text('{"fx": 500}')
    assert exit_code("calibrate", "synthetic:frames=2", "--out", str(tmp_path / out)) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == '{"fx": 500}'


GOOD = {"depth_late_s": -0.01, "depth_rows_s": 0, "color_rows_s": 0.03, "std_s": [0.001, 0.002, 0.003]}


@pytest.mark.parametrize("wrap", [lambda times: times, lambda times: {"source": "x", "sensor_times": times}])
def test_a_file_becomes_six_numbers(tmp_path: Path, wrap: Callable[[object], object]) -> None:
    (tmp_path / "a.json").write_text(json.dumps(wrap(GOOD)))
    settings = InputConfig(calibrate=str(tmp_path / "a.json"))
    assert settings.calibrate == "-0.01,0,0.03,0.001,0.002,0.003"
    again = replace(settings, limit=3), InputConfig(calibrate=settings.calibrate)
    assert [one.calibrate for one in again] == [settings.calibrate] * 2
    assert SensorTimes.given(settings.calibrate) == SensorTimes(-0.01, 0.0, 0.03, std_s=(0.001, 0.002, 0.003))
    assert SensorTimes.given("auto") is SensorTimes.given("off") is UNKNOWN_TIMES


NEEDED = "input.calibrate needs auto, off, or a file that `sigmasplat calibrate PATH` has written"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (json.dumps(GOOD | {"depth_rows_s": "soon"}), "a.json: depth_rows_s must be a number, found 'soon'; " + NEEDED),
        (
            json.dumps(GOOD | {"depth_late_s": -18}),
            "a.json: depth_late_s must be between -1 and 1, found -18",
        ),
        (json.dumps(GOOD | {"std_s": [0.1, 0.1]}), "a.json: std_s must be a number, found None; " + NEEDED),
        (json.dumps(GOOD | {"std_s": [0.1, -0.1, 0]}), "a.json: std_s must be between 0 and 1, found -0.1; " + NEEDED),
        ('{"sensor_times": [], "status": "complete"}', "a.json: depth_late_s must be a number, found None; " + NEEDED),
        ("[1, 2, 3, 4, 5, 6]", "a.json: depth_late_s must be a number, found None; " + NEEDED),
        ("colour", "a.json: not readable as JSON"),
        (None, "a.json'; " + NEEDED),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / "a.json").write_text(content)
    with pytest.raises(ConfigError) as refused:
        configured(None, {"input.calibrate": tmp_path / "a.json"})
    assert message in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("given", ["on", "", "1,2,3,4,5,x", "0,0,0,nan,0,0", "0.01"])
def test_bad_words_are_refused(given: str) -> None:
    with pytest.raises(ConfigError, match=r"calibrate needs auto, off, or a file|cannot read"):
        InputConfig(calibrate=given)


@pytest.mark.parametrize(("name", "value"), [("tracking.method", "adam"), ("tracking.fit_depth", True)])
def test_times_need_alignment_and_measured_depth(name: str, value: object) -> None:
    with pytest.raises(ConfigError, match=r"needs tracking\.method=align and depth that is not predicted"):
        Slam(settings={"input.calibrate": "0,0,0.03,0.001,0.001,0.001", name: value})


def test_nothing_late_is_said_with_its_error() -> None:
    times = SensorTimes(std_s=(0.0012, 0.003, 0.0004))
    assert times.said() == "the sensor reads nothing late (± 0.4 ms for colour, 3 ms for depth, 1 ms between both)"
    moving = np.ones(6)
    assert times.read(Readout(moving)) is None and times.read(Readout(moving, 0.01)) is not None
