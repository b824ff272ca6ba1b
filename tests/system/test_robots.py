"""Runs that write a bag: what a robot receives, and that the bag changes nothing in the run."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import exit_code
from ros_reading import covariance, links, pose, read_bag, seconds
from run_process import files_of_at_most
from sigmasplat.config import Config
from sigmasplat.config.find_preset import default_preset, preset
from sigmasplat.config.text import override
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import Slam
from small_room import frame_at, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")
pytest.importorskip("rosbags", reason="rosbags is not installed (extra `ros`)")
from sigmasplat.plugins.robots.bag import BagSink, LiveRobot
from sigmasplat.plugins.robots.ros_messages import Encoded

SETTINGS = {
    "input.width": "160", "mapping.first_iterations": "40", "mapping.iterations": "10", "final.iterations": "4",
    "submaps.distance_m": "0", "submaps.uncertainty_m": "0", "submaps.frames": "10",
    "loops.min_interval": "1", "loops.min_similarity": "0.3",
    "mapping.lr_pose_translation": "2e-4", "mapping.lr_pose_rotation": "1e-4", "registration.method": "few-steps",
    "mapping.divided": "false",
}  # fmt: skip
"""Mapping moves the keyframes of this short walk, so that the loop has something to correct. The walk is too short for
a search for loops that is divided over its frames."""
FRAMES = 26
ROOM = "synthetic:frames=60,width=64,height=48"
TINY = ("--set", "input.width=64", "--set", "mapping.first_iterations=3", "--set", "final.iterations=0")


@cache
def there_and_back() -> list[Frame]:
    """Walk thirteen frames ahead and the same way back, so that a loop is closed."""
    order = [*range(FRAMES // 2), *reversed(range(FRAMES // 2))]
    return [replace(frame_at(i), index=n, timestamp_s=n / 30.0) for n, i in enumerate(order)]


def settings() -> Config:
    return override(preset(default_preset()), SETTINGS)


def followed(folder: Path | None, warnings: list[str] | None = None) -> tuple[Slam, LiveRobot | None]:
    """Run, and write a bag to a folder if there is one."""
    slam, said = Slam(settings()), [] if warnings is None else warnings
    robot = None if folder is None else LiveRobot(slam, folder, said.append, "all")
    for frame in there_and_back():
        if robot is not None:
            robot.watch(frame)
        step = slam.step(frame)
        if robot is not None:
            robot(step)
    slam.finish()
    if robot is not None:
        robot.close()
    return slam, robot


def contents(slam: Slam) -> dict[str, bytes]:
    saved = {name: tensor.numpy().tobytes() for name, tensor in slam.checkpoint().items()}
    return saved | {"map": slam.field.params.numpy().tobytes()}


@cache
def plain() -> dict[str, bytes]:
    """Return what a run leaves behind without any consumer."""
    return contents(followed(None)[0])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Slam, Path, LiveRobot]:
    folder = tmp_path_factory.mktemp("robots") / "bag"
    slam, robot = followed(folder)
    assert robot is not None
    return slam, folder, robot


# ---- the bag ----


def test_a_bag_changes_nothing_in_the_run(recorded: tuple[Slam, Path, LiveRobot]) -> None:
    slam, _, robot = recorded
    assert contents(slam) == plain()
    assert robot.failure == "" and robot.written == 1 + 6 * FRAMES, "transforms, odometry, two images with camera_info"


def test_a_disk_that_fails_ends_the_bag_and_not_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, warnings = BagSink.write, list[str]()

    def failing(sink: BagSink, message: Encoded) -> None:
        if message.stamp_ns > 0.3e9:
            raise OSError(28, "No space left on device")
        write(sink, message)

    monkeypatch.setattr(BagSink, "write", failing)
    slam, robot = followed(tmp_path / "bag", warnings)
    assert robot is not None and contents(slam) == plain()
    assert (robot.written, robot.failure) == (61, "No space left on device")
    assert warnings == ["the bag ended (No space left on device) after 61 messages; the run goes on"]


def test_a_loop_moves_map_to_odom_and_the_odometry_is_continuous(recorded: tuple[Slam, Path, LiveRobot]) -> None:
    slam, folder, _ = recorded
    bag = read_bag(folder)
    transforms, odometry = [links(message) for message in bag["/tf"]], bag["/sigmasplat/odometry"]
    assert len(transforms) == len(odometry) == FRAMES
    static = links(bag["/tf_static"][-1])
    for T, moved, step in zip(transforms, odometry, slam.steps, strict=True):
        in_map = T["map", "odom"] @ T["odom", "camera_link"] @ static["camera_link", "camera_optical_frame"]
        np.testing.assert_allclose(in_map, static["map", "sigmasplat_world"] @ step.T_world_camera, atol=1e-6)
        np.testing.assert_allclose(pose(moved), T["odom", "camera_link"], atol=1e-9)
        assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "camera_link")
        assert seconds(moved) == pytest.approx(step.timestamp_s, abs=1e-8)
    at_loop = [i for i, step in enumerate(slam.steps) if any(loop.accepted for loop in step.loops)]
    assert at_loop, "this walk closes a loop before its end"
    corrections = [np.abs(b["map", "odom"] - a["map", "odom"]).max() for a, b in pairwise(transforms)]
    assert corrections[at_loop[0] - 1] > 1e-4, "the loop is in map → odom"
    along = np.stack([T["odom", "camera_link"] for T in transforms])
    steps_m = np.linalg.norm(np.diff(along[:, :3, 3], axis=0), axis=1)
    true = np.stack([T for T in _truth(slam)])
    true_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps_m, true_m, atol=5e-3)


def _truth(slam: Slam) -> np.ndarray:

    order = [*range(FRAMES // 2), *reversed(range(FRAMES // 2))]
    return walk().truth().T_world_camera[order]


def test_the_covariance_of_the_odometry_is_not_known(recorded: tuple[Slam, Path, LiveRobot]) -> None:
    assert all(covariance(message)[0, 0] == -1.0 for message in read_bag(recorded[1])["/sigmasplat/odometry"])


def test_our_own_source_reads_the_same_frames(tmp_path: Path) -> None:
    more = ("--no-eval", "--limit", "6", "--out", str(tmp_path / "run"), "--bag-images", "all")
    assert exit_code("run", ROOM, *more, "--bag", str(tmp_path / "bag"), *TINY) == 0
    source, again = open_source(ROOM), open_source(str(tmp_path / "bag"))
    facts = RunFolder(tmp_path / "run").facts()["bag"]
    assert facts["failure"] == "" and facts["written"] > 0 and len(again) == 6
    for i in range(6):
        wanted, found = source.frame(i), again.frame(i)
        assert found.camera == wanted.camera and found.timestamp_s == pytest.approx(wanted.timestamp_s, abs=1e-8)
        np.testing.assert_array_equal(found.depth_m, wanted.depth_m)
        np.testing.assert_allclose(found.color, wanted.color, atol=0.5 / 255 + 1e-6)
    assert again.truth() is None, "the estimated path of one run is no ground truth of the next one"


def test_a_resumed_run_writes_a_bag_of_its_own_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    more = ("--no-eval", "--out", str(tmp_path / "run"), "--save-every", "0.001", *TINY)
    step = Slam.step

    def stopped(slam: Slam, frame: Frame) -> Any:
        if frame.index == 3:
            raise KeyboardInterrupt
        return step(slam, frame)

    with monkeypatch.context() as patched:
        patched.setattr(Slam, "step", stopped)
        assert exit_code("run", ROOM, "--limit", "5", *more) == 130
    facts = RunFolder(tmp_path / "run").facts()
    assert facts["status"] == "interrupted" and "bag" not in facts
    assert exit_code("resume", str(tmp_path / "run"), "--no-eval", "--bag", str(tmp_path / "bag")) == 0
    bag, log = read_bag(tmp_path / "bag"), RunFolder(tmp_path / "run").read_log()
    new, times_s = len(bag["/tf"]), [record["timestamp_s"] for record in log]
    assert 2 <= new < 5, "the frames after the saved state"
    assert [seconds(message.transforms[0]) for message in bag["/tf"]] == pytest.approx(times_s[-new:], abs=1e-8)
    assert seconds(bag["/tf_static"][0].transforms[0]) == pytest.approx(times_s[-new], abs=1e-8)


@pytest.mark.slow
def test_a_full_disk_ends_the_bag_and_not_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    large = "synthetic:frames=60,width=320,height=240"
    more = ("--no-eval", "--limit", "8", *TINY)
    assert exit_code("run", large, "--out", str(tmp_path / "plain"), *more) == 0
    capsys.readouterr()
    with files_of_at_most(2_000_000):  # the run's own files are smaller, the bag is larger
        bag = ("--bag", str(tmp_path / "bag"), "--bag-images", "all")
        assert exit_code("run", large, "--out", str(tmp_path / "run"), *more, *bag) == 0
    said = capsys.readouterr().err
    assert said.count("the bag ended") == 1 and said.count("\n") == 1
    one, other = RunFolder(tmp_path / "plain"), RunFolder(tmp_path / "run")
    assert other.facts()["status"] == "complete" and other.facts()["bag"]["failure"] == "File too large"
    for name in ("trajectory.txt", "map.ply", "checkpoint.safetensors"):
        assert (one.path / name).read_bytes() == (other.path / name).read_bytes()


def test_mistakes_are_one_line_and_leave_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").mkdir()
    for place in ("taken", "bag.mcap", "no/bag"):
        given = ("--bag", str(tmp_path / place))
        assert exit_code("run", ROOM, "--out", str(tmp_path / "run"), "--no-eval", *TINY, *given) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_mcaps_own_reader_decodes_the_same(recorded: tuple[Slam, Path, LiveRobot]) -> None:
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed (make install-dev)")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    bag, seen = read_bag(recorded[1]), dict[str, list[Any]]()
    with (recorded[1] / "bag.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            seen.setdefault(channel.topic, []).append(message)
    assert {topic: len(messages) for topic, messages in seen.items()} == {t: len(m) for t, m in bag.items() if m}
    for one, other in zip(seen["/sigmasplat/odometry"], bag["/sigmasplat/odometry"], strict=True):
        np.testing.assert_array_equal(one.pose.covariance, other.pose.covariance)
        np.testing.assert_array_equal(pose(one), pose(other))
    for one, other in zip(seen["/tf"], bag["/tf"], strict=True):
        assert all(np.array_equal(T, links(other)[name]) for name, T in links(one).items())
