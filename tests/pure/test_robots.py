"""Messages for robots: frames, covariances, odometry, map; and a writer that never holds up a run."""

import json
import struct
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from command_line import exit_code
from room_run import FRAMES, LOST, PATH, made_run, picture
from ros_reading import covariance, decoded, image, links, matrix, points, pose, read_bag, seconds
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.relative_pose import UNKNOWN_HOP, Edges, RelativePose
from sigmasplat.data.trajectory import LOST as LOST_STATE, RELOCALISED, TRACKED
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.plugins.outputs.floorplan.floor_plan import FREE, OBJECT, UNOBSERVED, WALL, FloorPlan
from sigmasplat.plugins.robots.ros_messages import T_LINK_OPTICAL, levelled_map, link_pose, ros_covariance
from sigmasplat.system.slam import path_errors

pytest.importorskip("rosbags", reason="rosbags is not installed (extra `ros`)")
from sigmasplat.plugins.robots.bag import BagSink
from sigmasplat.plugins.robots.live import LiveOdometry, has_motion
from sigmasplat.plugins.robots.ros_messages import POSE, TF, RosMessages, stamp_of

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


def test_a_levelled_map_has_x_ahead_and_z_up() -> None:
    T_floor_world = se3.exp(np.array([0.0, 0.0, 0.0, -0.5 * np.pi, 0.0, 0.0]))
    T_floor_world[2, 3] = 1.4  # the first camera is level, 1.4 m above the floor
    T_map_world = levelled_map(np.round(T_floor_world, 12))
    np.testing.assert_allclose(T_map_world @ [0, 0, 2.0, 1], [2.0, 0, 1.4, 1], atol=1e-12)  # ahead of the first camera
    np.testing.assert_allclose(T_map_world @ [1.0, 0, 0, 1], [0, -1.0, 1.4, 1], atol=1e-12)  # right of it


def test_the_covariance_is_that_of_poses_drawn_in_the_outer_frame() -> None:
    """Perturb a pose in the world, express it in the outer frame, and measure position and rotation there."""
    T_outer_world, T_world_camera, C = some_pose(1), some_pose(2), some_covariance(3)
    T = link_pose(T_outer_world @ T_world_camera)
    root = np.linalg.cholesky(C)
    moved = []
    for xi in np.random.default_rng(4).normal(size=(20_000, 6)) @ root.T:
        drawn = link_pose(T_outer_world @ se3.exp(xi) @ T_world_camera)
        moved.append([*(drawn[:3, 3] - T[:3, 3]), *se3.log_rotation(drawn[:3, :3] @ T[:3, :3].T)])
    expected = np.cov(np.array(moved).T)
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs(ros_covariance(C, T_outer_world, T) - expected).max() < 0.05 * size.max()
    assert (np.abs(ros_covariance(C, T_outer_world, T) - expected) / size).max() < 0.05


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
    T, C = some_pose(5), some_covariance(6)
    sent = MESSAGES.odometry(1_500_000_001, "odom", "camera_link", T, C)
    read = decoded(sent.data, sent.topic.msgtype)
    assert (read.header.frame_id, read.child_frame_id) == ("odom", "camera_link")
    assert (read.header.stamp.sec, read.header.stamp.nanosec) == (1, 500_000_001)
    np.testing.assert_allclose(pose(read), T, atol=1e-12)
    np.testing.assert_array_equal(covariance(read), C)
    assert read.twist.covariance[0] == -1.0
    unknown, certain = (decoded(MESSAGES.pose(0, "map", T, c).data, POSE.msgtype) for c in (None, np.zeros((6, 6))))
    assert covariance(unknown)[0, 0] == -1.0 and (np.linalg.eigvalsh(covariance(certain)) > 0).all()
    tf = MESSAGES.transforms(TF, 5, [("map", "odom", T)])
    np.testing.assert_allclose(links(decoded(tf.data, TF.msgtype))["map", "odom"], T, atol=1e-12)
    assert stamp_of(-1.0) == 0 and stamp_of(1.5) == 1_500_000_000


def test_points_keep_position_colour_and_confidence() -> None:
    rng = np.random.default_rng(0)
    means, colors, std = (torch.from_numpy(rng.random(shape).astype(np.float32)) for shape in ((50, 3), (50, 3), 50))
    opacities = torch.linspace(0.3, 0.9, 50)
    std[30] = np.nan
    field = GaussianField.from_values(means, torch.full((50, 3), 0.01), colors, opacities=opacities)
    T, kept = some_pose(7), (field.opacities >= 0.5).numpy()
    for known in (std, None):
        sent = MESSAGES.cloud(0, "map", field, known, T)
        rows = points(decoded(sent.data, sent.topic.msgtype))
        assert 25 < len(rows) < 40
        np.testing.assert_allclose(
            np.stack([rows["x"], rows["y"], rows["z"]], 1), (means.numpy() @ T[:3, :3].T + T[:3, 3])[kept], atol=1e-5
        )
        packed = rows["rgb"].view(np.uint32)
        rgb = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], 1)
        np.testing.assert_array_equal(rgb, np.rint(255 * colors.numpy()[kept]))
        np.testing.assert_array_equal(rows["depth_std"], std.numpy()[kept] if known is not None else np.nan)
        np.testing.assert_array_equal(rows["opacity"], field.opacities.numpy()[kept])


def test_the_grid_has_the_cells_of_the_plan() -> None:
    kind = np.array([[UNOBSERVED, FREE, OBJECT], [FREE, WALL, UNOBSERVED]], np.uint8)
    std = np.array([[np.nan, 0.013, 0.02], [0.004, 7.0, np.nan]], np.float32)
    nothing = np.zeros_like(std)
    plan = FloorPlan(0.05, np.array([-1.0, 2.0]), np.eye(4), kind, nothing, std, nothing, np.zeros((0, 2)))
    sent = MESSAGES.grid(0, "map", plan)
    occupied = decoded(sent.data, sent.topic.msgtype)
    assert occupied.info.resolution == pytest.approx(0.05)
    assert (occupied.info.origin.orientation.w, occupied.header.frame_id) == (1.0, "map")
    cells, wanted, corner = occupied.data.reshape(3, 2), {"?": -1, "f": 0, "o": 100}, occupied.info.origin.position
    assert (occupied.info.height, occupied.info.width) == (3, 2)
    for name, x_right, y_ahead in (("?", -0.975, 2.025), ("f", -0.925, 2.025), ("o", -0.875, 2.025)):
        column, row = int((y_ahead - corner.x) / 0.05), int((-x_right - corner.y) / 0.05)
        assert cells[row, column] == wanted[name]
    assert sorted(occupied.data.tolist()) == [-1, -1, 0, 0, 100, 100]


# ---- the bag ----


def test_a_bag_that_was_not_completed_holds_its_messages(tmp_path: Path) -> None:
    """What `mcap recover` reads after a crash: complete chunks in the file."""
    sink = BagSink(tmp_path / "bag")
    sink.open(MESSAGES)
    sent = [MESSAGES.odometry(i, "odom", "camera_link", some_pose(i), None) for i in range(300)]
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


# ---- export of a finished run ----


def test_a_run_is_exported_as_a_bag(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", submaps=True)
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "run.mcap"), "--pictures") == 0
    found = read_bag(tmp_path / "run.mcap")
    kept = [i for i in range(FRAMES) if i != LOST]
    static = links(found["/tf_static"][0])
    T_map_world, T_link_optical = static["map", "sigmasplat_world"], static["camera_link", "camera_optical_frame"]
    assert [seconds(m) for m in found["/sigmasplat/pose"]] == pytest.approx([i / 10 for i in kept])
    for row, tf, at in zip(kept, found["/tf"], found["/sigmasplat/pose"], strict=True):
        T_map_optical = links(tf)["map", "camera_link"] @ T_link_optical
        np.testing.assert_allclose(T_map_optical, T_map_world @ PATH.T_world_camera[row], atol=1e-6)
        np.testing.assert_allclose(pose(at) @ T_link_optical, T_map_optical, atol=1e-6)
        assert at.header.frame_id == "map" and covariance(at)[0, 0] == -1.0, "this run did not record its errors"
    up = T_map_world[:3, :3] @ PATH.T_world_camera[0, :3, 1]
    assert up[2] < -0.8, "down of the camera is down of the map"
    assert [image(m)[0, 1, 0] for m in found["/camera/color/image_raw"]] == [0, 20, 40]
    depth = image(found["/camera/aligned_depth_to_color/image_raw"][1])
    assert np.isnan(depth[0, 0])
    np.testing.assert_array_equal(depth.ravel()[1:], picture(2).depth_m.ravel()[1:])
    cells = found["/map"][0]
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "run.plan.png")) == 0
    rows = json.loads((tmp_path / "run.plan.json").read_text())["cells"]
    values = [[{"?": -1, ",": -1, ".": 0, "o": 100, "#": 100}[sign] for sign in row] for row in rows]
    turned = cells.data.reshape(cells.info.height, cells.info.width)[::-1].T  # the plan has x right, y ahead
    np.testing.assert_array_equal(turned, values)
    assert (cells.data == 0).any() and cells.header.frame_id == "map"
    assert abs(cells.info.origin.position.z) < 1e-6
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "run.mcap")) == 2
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "run.mcap"), "--overwrite") == 0
    assert "/camera/color/image_raw" not in {k for k, v in read_bag(tmp_path / "run.mcap").items() if v}
    assert len(read_bag(tmp_path / "run.mcap")["/tf"]) == len(kept)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "run.mcap", "run.plan.json", "run.plan.png"]


def test_the_grid_and_the_points_lie_in_the_same_map(tmp_path: Path) -> None:
    """Occupied cells have points above the floor; walls of the room lie at the edges of the free floor."""
    run = made_run(tmp_path / "run", submaps=True)
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "run.mcap")) == 0
    found = read_bag(tmp_path / "run.mcap")
    rows, grid = points(found["/sigmasplat/cloud"][0]), found["/map"][0]
    field = run.read_map()
    assert len(rows) == int((field.opacities >= 0.5).sum())
    T = links(found["/tf_static"][0])["map", "sigmasplat_world"]
    opaque = field.means[field.opacities >= 0.5].numpy()
    xyz = np.stack([rows["x"], rows["y"], rows["z"]], 1)
    np.testing.assert_allclose(xyz, opaque @ T[:3, :3].T + T[:3, 3], atol=1e-4)
    origin = grid.info.origin
    T_grid_map = se3.inverse(matrix(origin.position, origin.orientation))
    in_grid = xyz @ T_grid_map[:3, :3].T + T_grid_map[:3, 3]
    cells = np.floor(in_grid[:, :2] / grid.info.resolution).astype(int)
    occupancy = grid.data.reshape(grid.info.height, grid.info.width)
    on_floor = np.abs(in_grid[:, 2]) < 0.03
    inside = on_floor & (cells >= 0).all(1) & (cells < [grid.info.width, grid.info.height]).all(1)
    values = occupancy[cells[inside, 1], cells[inside, 0]]
    assert inside.sum() > 100 and (values == 0).mean() > 0.5, "points at the height of the floor are free floor"


def test_the_exported_covariance_is_that_of_the_path(tmp_path: Path) -> None:
    run = made_run(tmp_path / "run", submaps=True)
    atlas = Atlas()
    atlas.begin_submap()
    for i in range(FRAMES):
        if i in (0, 2, 4):
            hop = UNKNOWN_HOP if i == 0 else RelativePose.hop(np.eye(4), some_covariance(i), np.zeros(6))
            atlas.set_keyframes([*atlas.keyframe_poses[-1], PATH.T_world_camera[i]], hop)
        atlas.place_frame(PATH.T_world_camera[i])
    tensors = run.read_checkpoint()[0] | path_errors(atlas, [0, 2, 4], Edges())
    run.write_checkpoint({name: torch.as_tensor(value).contiguous() for name, value in tensors.items()}, {})
    errors = PathCovariance.of(tensors)
    assert errors is not None
    assert exit_code("export", str(run.path), "--out", str(tmp_path / "run.mcap")) == 0
    found = read_bag(tmp_path / "run.mcap")
    T_map_world = links(found["/tf_static"][0])["map", "sigmasplat_world"]
    for row, message in zip([i for i in range(FRAMES) if i != LOST], found["/sigmasplat/pose"], strict=True):
        expected = ros_covariance(errors.of_frame(row), T_map_world, pose(message))
        expected = expected if expected.any() else 1e-10 * np.eye(6)
        np.testing.assert_allclose(covariance(message), expected, rtol=1e-5, atol=1e-12)


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
