"""The examples for your own camera run: OpenCV's capture, a ROS 2 node and a notebook, without their hardware."""

import ast
import json
import signal
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import fake_rclpy
import sigmasplat
from documents import ROOT
from module_files import module_from
from sigmasplat import Slam
from sigmasplat.data import se3
from small_room import SMALL, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

EXAMPLES = ROOT / "examples"
FAST = SMALL | {"mapping.first_iterations": "20", "mapping.iterations": "8", "final.iterations": "6"}
K = (128.0, 128.0, 79.5, 59.5)


def images(i: int) -> tuple[np.ndarray, np.ndarray]:
    frame = walk().frame(i)
    return np.rint(255 * frame.color).astype(np.uint8), np.rint(1000 * frame.depth_m).astype(np.uint16)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Make SLAM short; work in an empty folder."""
    monkeypatch.setattr(sigmasplat, "Slam", lambda preset, **settings: Slam(preset, settings=FAST))
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Capture:
    """A simulated cv2.VideoCapture of an Orbbec camera: no depth in the first image, Ctrl-C at the eighth."""

    def __init__(self, number: int, backend: int) -> None:
        assert (number, backend) == (0, cv2.CAP_OBSENSOR)
        self.count, self.released = -1, False

    def get(self, number: int) -> float:
        return K[
            [getattr(cv2, f"CAP_PROP_OBSENSOR_INTRINSIC_{name}") for name in ("FX", "FY", "CX", "CY")].index(number)
        ]

    def grab(self) -> bool:
        self.count += 1
        if self.count == 7:
            signal.raise_signal(signal.SIGINT)  # Ctrl-C while an image is read
        return True

    def retrieve(self, image: None, flag: int) -> tuple[bool, np.ndarray | None]:
        color, depth = images(self.count)
        if flag == cv2.CAP_OBSENSOR_BGR_IMAGE:
            return self.count != 5, None if self.count == 5 else color[..., ::-1].copy()
        assert flag == cv2.CAP_OBSENSOR_DEPTH_MAP
        return True, depth * (self.count > 0)

    def release(self) -> None:
        self.released = True


def test_opencvs_capture(quick: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", Capture)
    slam = module_from(EXAMPLES / "opencv_camera.py").main("out").slam
    assert [step.state for step in slam.steps] == ["tracked"] * 6
    seen = slam.store.picture(0, 0).color
    assert np.abs(seen.astype(int) - images(1)[0]).max() <= 1, "colours are in the order red, green, blue"
    output = capsys.readouterr().out
    assert output.count("tracked") == 6 and "no depth reading" in output and "final map" in output
    assert (quick / "out" / "trajectory.txt").stat().st_size and (quick / "out" / "map.ply").stat().st_size


# ---- ROS 2 ----


def camera_info() -> Any:
    message = fake_rclpy.new("sensor_msgs/msg/CameraInfo")
    fx, fy, cx, cy = K
    message.p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
    return message


def send_pair(robot: fake_rclpy.Robot, i: int, kind: str) -> None:
    """Send colour and depth of a frame; depth is 4 ms late."""
    color, depth = images(i)
    encoding = "bgr8" if "bgr" in kind else "rgb8"
    color = color[..., ::-1] if "bgr" in kind else color
    metres = np.where(depth > 0, depth / 1000, np.nan).astype(np.float32)
    padded = dict(pad=3) if "padded" in kind else {}
    sent = (metres, "32FC1") if "metres" in kind else (depth, "16UC1")
    robot.send("color", fake_rclpy.image(color, encoding, 1e9 + i / 30, "camera_optical", **padded))
    late = 1e9 + i / 30 + 0.004
    robot.send("depth", fake_rclpy.image(*sent, late, "camera_optical", big="big-endian" in kind, **padded))


@pytest.mark.parametrize("kind", ["rgb, millimetres", "bgr, metres", "rgb, millimetres, big-endian, padded"])
def test_the_ros_2_node_publishes_poses(kind: str, quick: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = fake_rclpy.Robot()
    robot.install(monkeypatch)
    module, nodes = module_from(EXAMPLES / "ros2_node.py"), []

    def spun() -> None:
        send_pair(robot, 0, kind)  # the camera is not known yet
        robot.send("camera_info", camera_info())
        for i in range(8):
            send_pair(robot, i, kind)
        color, depth = images(8)
        robot.send("color", fake_rclpy.image(color[..., 0].copy(), "mono8", 1e9 + 1, "camera_optical"))
        robot.send("depth", fake_rclpy.image(depth, "16UC1", 1e9 + 1, "camera_optical"))

    robot.spun = spun
    made = module.SlamNode
    monkeypatch.setattr(module, "SlamNode", lambda: nodes.append(made()) or nodes[0])
    module.main()
    assert (quick / "map.ply").stat().st_size and len(robot.warnings) == 2
    assert "K is None" in robot.warnings[0] and "mono8" in robot.warnings[1]
    steps = nodes[0].slam.slam.steps
    assert len(robot.published) == len(steps) == 8
    R = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    for (topic, message), step in zip(robot.published, steps, strict=True):
        assert (topic, message.header.frame_id, message.child_frame_id) == ("odometry", "map", "camera_optical")
        assert fake_rclpy.time_s(message) == pytest.approx(step.timestamp_s, abs=1e-6)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        assert np.allclose([p.x, p.y, p.z], R @ step.T_world_camera[:3, 3])
        assert np.allclose(
            se3.rotation_from_quaternion(np.array([q.w, q.x, q.y, q.z])), R @ step.T_world_camera[:3, :3]
        )
    covariances = [message.pose.covariance.reshape(6, 6) for _, message in robot.published]
    assert not covariances[0].any() and all(np.linalg.eigvalsh(C).min() > 0 for C in covariances[1:])
    nodes[0].publish(robot.published[0][1].header, np.eye(4), np.diag([1.0, 2, 3, 4, 5, 6]))
    turned = robot.published[-1][1].pose.covariance.reshape(6, 6)
    assert np.allclose(turned, np.diag([3.0, 1, 2, 6, 4, 5])), "z of the world is x of the map"


def test_the_ros_2_node_has_60_lines_of_code() -> None:
    text = (EXAMPLES / "ros2_node.py").read_text(encoding="utf-8")
    nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
    documented = {line for node in nodes if isinstance(node.value, ast.Constant)
                  for line in range(node.lineno, (node.end_lineno or 0) + 1)}  # fmt: skip
    lines = [line for number, line in enumerate(text.splitlines(), 1) if line.strip() and number not in documented]
    assert len(lines) <= 60


# ---- notebook ----


def test_the_notebook_runs(quick: Path, capsys: pytest.CaptureFixture[str]) -> None:
    notebook = json.loads((EXAMPLES / "own_camera.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert notebook["nbformat"] == 4 and len(cells) >= 6
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells), "saved without outputs"
    names: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"own_camera.ipynb, cell {number}", "exec"), names)
    assert not any(step.lost for step in names["slam"].steps)
    assert "keyframe" in capsys.readouterr().out
