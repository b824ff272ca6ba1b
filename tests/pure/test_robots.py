"""Messages for robots: frames, covariances, odometry, map; and a writer that never holds up a run."""

import struct
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from ros_reading import covariance, decoded, links, pose
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.data.trajectory import LOST as LOST_STATE, RELOCALISED, TRACKED
from sigmasplat.plugins.robots.ros_messages import T_LINK_OPTICAL

pytest.importorskip("rosbags", reason="rosbags is not installed (extra `ros`)")
from sigmasplat.plugins.robots.bag import BagSink, LiveOdometry, has_motion
from sigmasplat.plugins.robots.ros_messages import TF, RosMessages, stamp_of

Array = NDArray[np.float64]
MESSAGES = RosMessages()


def some_pose(seed: int) -> Array:
    return se3.exp(np.random.default_rng(seed).normal(size=6) * [2.0, 1.0, 2.0, 0.4, 1.0, 0.4])


def some_covariance(seed: int, scale: float = 1e-3) -> Array:
    A = scale * np.random.default_rng(seed).normal(size=(6, 6))
    return A @ A.T


# ---- frames ----


def test_body_axes_are_forward_left_up() -> None:
    right, down, forward = T_LINK_OPTICAL[:3, :3].T
    assert forward.tolist() == [1, 0, 0] and right.tolist() == [0, -1, 0] and down.tolist() == [0, 0, -1]
    assert se3.is_rigid(T_LINK_OPTICAL)


# ---- odometry ----


def grown(atlas: Atlas, T_submap_camera: Array, hop: RelativePose | None = None) -> None:
    """Add a frame; with a hop it is a keyframe."""
    if hop is not None:
        atlas.set_keyframes([*atlas.keyframe_poses[-1], T_submap_camera], hop)
    atlas.place_frame(T_submap_camera)


def walked(corrections: bool) -> tuple[list[Array], list[Array]]:
    """Walk through three submaps; return the live odometry and the poses in the world at each frame. corrections: a
    loop moves the anchors, and mapping moves a keyframe."""
    atlas, rng = Atlas(), np.random.default_rng(0)
    atlas.begin_submap()
    odometry, T_odom, T_world = LiveOdometry(atlas), list[Array](), list[Array]()
    T = np.eye(4)
    for i in range(30):
        T = T @ se3.exp(rng.normal(size=6) * 0.02)
        is_keyframe = i % 3 == 0
        if i and i % 12 == 0:  # a cut: the submap ends with this keyframe, and the next one begins with it
            grown_keyframe = [*atlas.keyframe_poses[-1], T]
            atlas.set_keyframes(grown_keyframe, RelativePose.hop(np.eye(4), some_covariance(i), np.zeros(6)))
            atlas.begin_submap(T)
            if corrections:
                atlas.anchors[-1] = se3.exp(np.full(6, 0.1)) @ atlas.anchors[-1]
            T = np.eye(4)
        if corrections and i == 20:
            atlas.keyframe_poses[-1][-1] = se3.exp(np.full(6, 1e-3)) @ atlas.keyframe_poses[-1][-1]
            T = se3.exp(np.full(6, 1e-3)) @ T  # tracking follows the keyframe
        grown(atlas, T, RelativePose.hop(np.eye(4), some_covariance(i), np.zeros(6)) if is_keyframe else None)
        T_odom.append(odometry.step(True, False).copy())
        T_world.append(atlas.anchors[-1] @ T)
    return T_odom, T_world


def test_corrections_do_not_move_the_odometry() -> None:
    free, _ = walked(corrections=False)
    corrected, T_world = walked(corrections=True)
    np.testing.assert_allclose(corrected, free, atol=1e-9)
    T_map_odom = [a @ se3.inverse(b) for a, b in zip(T_world, corrected, strict=True)]
    moves = [np.abs(b - a).max() > 1e-9 for a, b in pairwise(T_map_odom)]
    assert [i + 1 for i, moved in enumerate(moves) if moved] == [12, 20, 24]


def test_motion_without_tracking_is_left_out() -> None:
    atlas = Atlas()
    atlas.begin_submap()
    odometry = LiveOdometry(atlas)
    hop = RelativePose.hop(np.eye(4), some_covariance(0), np.zeros(6))
    at = []
    relocalised, tracked, gone = (False, False), (True, False), (False, True)
    for i, (moved, lost) in enumerate([tracked, tracked, gone, tracked, relocalised, tracked]):
        grown(atlas, se3.exp(np.array([0.1 * i, 0, 0, 0, 0, 0])), hop)
        at.append(float(odometry.step(moved, lost)[0, 3]))
    assert at == pytest.approx([0.0, 0.1, 0.1, 0.3, 0.3, 0.4])
    assert has_motion(TRACKED, {}) and not has_motion(LOST_STATE, {}) and not has_motion(RELOCALISED, {})
    assert not has_motion("apart", {"inliers": 40.0})


# ---- messages ----


def test_messages_hold_what_they_are_given() -> None:
    T = some_pose(5)
    sent = MESSAGES.odometry(1_500_000_001, "odom", "camera_link", T)
    read = decoded(sent.data, sent.topic.msgtype)
    assert (read.header.frame_id, read.child_frame_id) == ("odom", "camera_link")
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1, 500_000_001)
    np.testing.assert_allclose(pose(read), T, atol=1e-12)
    assert covariance(read)[0, 0] == -1.0 and read.twist.covariance[0] == -1.0
    tf = MESSAGES.transforms(TF, 5, [("map", "odom", T)])
    np.testing.assert_allclose(links(decoded(tf.data, TF.msgtype))["map", "odom"], T, atol=1e-12)
    assert stamp_of(-1.0) == 0 and stamp_of(1.5) == 1_500_000_000


def test_images_have_the_pinhole_of_their_camera() -> None:
    camera = Camera(4, 3, 5.0, 6.0, 1.5, 1.25)
    color, depth = np.full((3, 4, 3), 0.5, np.float32), np.full((3, 4), 1.25, np.float32)
    sent = MESSAGES.images(0, camera, color, depth)
    read = [SimpleNamespace(topic=m.topic.name, message=decoded(m.data, m.topic.msgtype)) for m in sent]
    infos = [r.message for r in read if r.topic.endswith("camera_info")]
    assert len(infos) == 2
    for info in infos:
        assert info.k.tolist() == [5.0, 0, 1.5, 0, 6.0, 1.25, 0, 0, 1.0] and (info.width, info.height) == (4, 3)
        assert info.header.frame_id == "camera_optical_frame"


# ---- the bag ----


def test_a_bag_that_was_not_completed_holds_its_messages(tmp_path: Path) -> None:
    """What `mcap recover` reads after a crash: complete chunks in the file."""
    sink = BagSink(tmp_path / "bag")
    sink.open(MESSAGES)
    sent = [MESSAGES.odometry(i, "odom", "camera_link", some_pose(i)) for i in range(300)]
    for message in sent:
        sink.write(message)
    data = (tmp_path / "bag" / "bag.mcap").read_bytes()
    at, messages = 8, 0
    while at < len(data):
        code, size = struct.unpack_from("<BQ", data, at)
        messages += (size - 6) // 16 * (code == 7)  # an index of the messages of one channel
        at += 9 + size
    sink.abort()
    assert at == len(data) and 200 < messages <= 300
    assert not (tmp_path / "bag" / "metadata.yaml").exists()
