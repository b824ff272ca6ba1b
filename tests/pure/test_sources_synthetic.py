"""The synthetic room: geometry, consistency of views, determinism, sensor noise."""

from itertools import pairwise

import numpy as np
import pytest

from paper_settings import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.errors import SourceError
from sigmasplat.plugins.sources import SyntheticRoom, open_source, synthetic
from sigmasplat.plugins.sources.room.capture import (
    DRIFT_KNOT_FRAMES,
    camera_path,
    drifted_depth,
    measured_depth,
    noise_sigma_m,
)
from sigmasplat.plugins.sources.room.render import build_scene, render_scene
from sigmasplat.plugins.sources.room.shapes import Rays, Shape, cast_rays, image_windows, surface_at
from sigmasplat.plugins.sources.room.textures import Material, noise, plain
from view_agreement import agreement

MATT = Material(plain((0.5, 0.5, 0.5)))
# Options, frame; camera's position, m; depths of 9 pixels, m; colours of 3, in 255 steps.
GOLDEN = [
    ("noise=1,seed=3", 50, [0.516978, -0.515955, 1.376988],
     [2.6355, 3.2914, 2.3862, 2.7866, 0.0, 2.5134, 2.6142, 0.0, 1.8751],
     [161, 109, 90, 130, 65, 54, 182, 160, 178]),
    ("frames=600,rooms=2", 400, [2.478756, 0.120664, 1.489477],
     [3.2718, 3.2744, 3.2770, 3.4841, 4.9634, 4.7021, 2.7225, 1.8368, 1.3509],
     [202, 197, 184, 154, 105, 87, 80, 54, 33]),
    ("frames=400,loops=2,noise=1,exposure_change=0", 310, [0.806492, -0.205294, 1.263493],
     [2.7702, 3.1680, 0.0, 2.8647, 3.3803, 0.0, 0.0, 0.9806, 0.0],
     [141, 92, 76, 160, 108, 91, 70, 61, 52]),
    ("corridor", 5, [-1.404376, -0.090769, 1.458459],
     [1.3089, 1.6492, 1.5545, 1.2888, 8.8135, 1.5476, 1.2951, 2.6199, 1.5781],
     [170, 104, 71, 190, 189, 182, 163, 162, 126]),
]  # fmt: skip


@pytest.fixture(autouse=True)
def rendered_anew(monkeypatch):
    """Frames made twice are rendered twice here, unlike in other tests (conftest.py)."""
    monkeypatch.setattr(synthetic, "render_scene", render_scene)


def shape(kind, center, half, yaw_rad=0.0):
    return Shape(kind, np.array(center, np.float32), np.array(half, np.float32), yaw_rad, MATT)


@pytest.mark.parametrize(("i", "j"), [(0, 4), (60, 66), (130, 120)])
def test_two_views_agree_on_common_surfaces(i, j):
    """Wrong pose directions, axes, focal lengths, or ray length instead of z give much larger errors."""
    behind_m, near = agreement(SyntheticRoom(width=160, height=120), i, j)
    assert near.mean() > 0.9
    assert np.median(np.abs(behind_m[near])) < 0.004
    assert (behind_m < -0.05).mean() < 0.02, "points of one view must not be in front of the other view's surface"


def test_two_views_agree_across_rooms():
    behind_m, near = agreement(SyntheticRoom(frames=600, width=200, height=150, rooms=2), 70, 76)
    assert near.mean() > 0.85
    assert np.median(np.abs(behind_m[near])) < 0.006


def test_matt_surfaces_keep_their_colour_between_views():
    room = SyntheticRoom(frames=200, width=160, height=120, exposure_change=False)
    a, b = room.frame(70), room.frame(72)
    T = se3.inverse(room.truth().T_world_camera[72]) @ room.truth().T_world_camera[70]
    x, y, z = np.moveaxis(room.camera.rays() * a.depth_m[..., None], -1, 0).reshape(3, -1)
    x, y, z = (T[:3, :3] @ np.stack([x, y, z])) + T[:3, 3:]
    u = np.rint(room.camera.fx * x / z + room.camera.cx).astype(int)
    v = np.rint(room.camera.fy * y / z + room.camera.cy).astype(int)
    inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
    difference = np.abs(a.color.reshape(-1, 3)[inside] - b.color[v[inside], u[inside]]).max(-1)
    assert np.median(difference) < 0.03


def test_depth_is_along_the_axis_not_along_the_ray():
    wall = shape("box", (0, 3, 0), (50, 1, 50))  # its face is the plane y = 2
    camera = Camera(64, 48, 40.0, 40.0, 31.5, 23.5)
    looking_along_y = np.eye(4)
    looking_along_y[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    rays = camera.rays().reshape(-1, 3).T
    directions = (looking_along_y[:3, :3] @ rays).astype(np.float32)
    t, hit = cast_rays([wall], Rays(np.zeros((3, 1), np.float32), directions))
    assert (hit == 0).all() and np.abs(t - 2.0).max() < 1e-5


def test_entry_points_and_normals_computed_by_hand():
    for kind, half, yaw_rad, direction, entry, normal in [
        ("ball", (1, 1, 1), 0.0, (1, 0, 0), 4.0, (-1, 0, 0)),
        ("ball", (2, 1, 1), 0.0, (1, 0, 0), 3.0, (-1, 0, 0)),
        ("ball", (2, 1, 1), np.pi / 2, (1, 0, 0), 4.0, (-1, 0, 0)),
        ("box", (1, 2, 3), 0.0, (1, 0, 0), 4.0, (-1, 0, 0)),
        ("box", (1, 2, 3), np.pi / 2, (1, 0, 0), 3.0, (-1, 0, 0)),
        ("box", (1, 1, 1), np.pi / 4, (1, 0.001, 0), 5.0 - np.sqrt(2), (-np.sqrt(0.5), np.sqrt(0.5), 0)),
        ("drum", (1, 1, 2), 0.0, (1, 0, 0), 4.0, (-1, 0, 0)),
        ("drum", (1, 1, 0.5), 0.0, (1, 0, 0.12), 0.5 / 0.12, (0, 0, 1)),
    ]:
        start_z = 1.0 if normal == (0, 0, 1) else 0.0  # the last ray comes from above the cap
        slope = np.array(direction, np.float32) * [1, 1, -1 if start_z else 1]
        solid = shape(kind, (5, 0, 0), half, yaw_rad)
        origin, ray = np.array([[0], [0], [start_z]], np.float32), slope.astype(np.float32)[:, None]
        t = solid.first_hit(origin, ray)
        assert t[0] == pytest.approx(entry, rel=2e-3)
        normals, _, _ = surface_at(solid, origin + ray * t)
        assert normals[:, 0] == pytest.approx(np.array(normal), abs=2e-3)


def test_rays_beside_or_away_from_a_shape_miss():
    for kind in ("box", "ball", "drum"):
        solid = shape(kind, (5, 0, 0), (1, 1, 1))
        rays = np.array([[1, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)  # columns: beside, backwards, upwards
        assert np.isinf(solid.first_hit(np.zeros((3, 1), np.float32), rays)).all()


def test_image_windows_do_not_change_the_result():
    """The image windows only save time: casting every shape at every pixel gives the same surfaces."""
    view, room = build_scene(1, 0), SyntheticRoom(frames=8, width=80, height=60)
    for T in room.truth().T_world_camera[::3]:
        pixels = np.indices((60, 80), np.float32).reshape(2, -1)[::-1]
        directions = (T[:3, :3] @ room.camera.rays().reshape(-1, 3).T).astype(np.float32)
        rays = Rays(T[:3, 3:].astype(np.float32), directions, pixels)
        t, hit = cast_rays(view.shapes, rays, image_windows(view.shapes, se3.inverse(T), room.camera))
        t_all, hit_all = cast_rays(view.shapes, rays)
        assert np.array_equal(hit, hit_all) and np.array_equal(t, t_all)


def test_every_ray_hits_the_room():
    for rooms in (1, 2):
        source = SyntheticRoom(frames=9, width=48, height=36, rooms=rooms, seed=3)
        for i in range(9):
            frame = source.frame(i)
            assert (frame.depth_m > 0.2).all() and (frame.depth_m < 13).all()


def test_same_seed_same_bytes_in_any_order():
    first = SyntheticRoom(frames=12, width=64, height=48, seed=3, noise=True)
    second = SyntheticRoom(frames=12, width=64, height=48, seed=3, noise=True)
    forwards = [first.frame(i) for i in (2, 5, 9)]
    backwards = [second.frame(i) for i in (9, 5, 2)][::-1]
    for a, b in zip(forwards, backwards, strict=True):
        assert a.color.tobytes() == b.color.tobytes() and a.depth_m.tobytes() == b.depth_m.tobytes()
    other = SyntheticRoom(frames=12, width=64, height=48, seed=4, noise=True)
    assert other.frame(2).color.tobytes() != forwards[0].color.tobytes()


def test_the_camera_path_is_smooth_closed_and_rigid():
    for frames, loops, rooms in [(200, 1, 1), (400, 2, 1), (600, 1, 2), (900, 1, 3)]:
        T = camera_path(frames, loops, rooms, seed=1)
        assert all(se3.is_rigid(pose, 1e-9) for pose in T)
        assert np.abs(T[0] - T[-1]).max() < 1e-6
        steps_m = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
        turns_deg = [np.degrees(se3.rotation_angle(a[:3, :3].T @ b[:3, :3])) for a, b in pairwise(T)]
        assert steps_m.min() > 0.01 and steps_m.max() < 0.032
        assert max(turns_deg) < 2.2
        if loops > 1:
            half = frames // 2
            assert np.abs(T[:half, 2, 3] - T[half:, 2, 3]).max() > 0.2, "loops run at different heights"


def test_exposure_varies_by_eight_percent():
    room, steady = (SyntheticRoom(frames=9, width=32, height=24, exposure_change=e) for e in (True, False))
    dark = steady.frame(2).color < 0.9
    gain = room.frame(2).color[dark].mean() / steady.frame(2).color[dark].mean()
    assert gain == pytest.approx(1.08, abs=0.005)
    assert np.array_equal(room.frame(8).color, room.frame(0).color)


def test_the_mirror_changes_colour_with_the_viewpoint():
    """The colour of panel and sphere depends on the viewpoint; depth is that of the panel."""
    view, camera = build_scene(1, 0), Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    mirror = next(s for s in view.shapes if s.material.mirror > 0.5)
    seen = []
    for x in (0.6, 1.9):
        eye = np.array([x, 0.6, 1.5])
        forward = mirror.center - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        T[:3, 3] = eye
        color, depth_m = render_scene(view, camera, T)
        assert depth_m[14, 20] == pytest.approx(np.linalg.norm(mirror.center - eye), abs=0.1)
        seen.append(color[10:20, 15:25].reshape(-1, 3).mean(0))
    assert np.abs(seen[0] - seen[1]).max() > 0.02


def test_sensor_noise_grows_with_the_square_of_depth():
    camera, rng = Camera(160, 120, 128.0, 128.0, 79.5, 59.5), np.random.default_rng(0)
    for depth_m in (1.0, 2.0, 4.0):
        wall = np.full((120, 160), depth_m, np.float32)
        read = measured_depth(wall, camera, rng)
        spread = (read[read > 0] - depth_m).std()
        assert spread == pytest.approx(0.0012 + 0.0019 * (depth_m - 0.4) ** 2, rel=0.05)
        assert spread == pytest.approx(float(noise_sigma_m(wall)[0, 0]), rel=0.05)
        assert 0.005 < (read == 0).mean() < 0.1, "few speckles and patches"


def test_sensor_loses_grazing_surfaces_edges_and_far_ones():
    camera, rng = Camera(160, 120, 128.0, 128.0, 79.5, 59.5), np.random.default_rng(0)
    assert (measured_depth(np.full((120, 160), 9.0, np.float32), camera, rng) == 0).all()
    step = np.full((120, 160), 3.0, np.float32)
    step[:, 80:] = 1.0
    lost = measured_depth(step, camera, rng) == 0
    assert lost[:, 79:81].mean() > 0.6 and lost[:, 20:60].mean() < 0.1
    down = camera.rays()[..., 1]  # a floor 10 cm below the camera, seen at less than 4°
    floor = np.where(down > 0.02, 0.1 / np.maximum(down, 1e-6), 5.0).astype(np.float32)
    band = (down > 0.025) & (down < 0.06)
    assert (measured_depth(floor, camera, rng)[band] == 0).mean() > 0.95


def test_noise_option_changes_depth_and_leaves_holes():
    clean, noisy = (SyntheticRoom(frames=5, width=96, height=72, noise=n).frame(1) for n in (False, True))
    both = (clean.depth_m > 0) & (noisy.depth_m > 0)
    assert 0.01 < (noisy.depth_m == 0).mean() < 0.3 and (clean.depth_m > 0).all()
    assert 0.001 < np.median(np.abs(clean.depth_m - noisy.depth_m)[both]) < 0.03


def drift_errors(indices, seed=0, deviation=0.01):
    wall = np.full((30, 40), 2.0, np.float32)
    return np.stack([drifted_depth(wall, i, seed, deviation) / 2.0 - 1.0 for i in indices])


def test_drift_has_the_requested_deviation_and_no_bias():
    errors = np.stack([drift_errors([1000], seed)[0] for seed in range(400)])
    assert errors.std() == pytest.approx(0.01, rel=0.08)
    assert np.abs(errors.mean(0)).max() < 0.004
    other = np.stack([drift_errors([130], seed)[0] for seed in range(400)])
    assert other.std() == pytest.approx(0.01, rel=0.08), "equal between and at the knots"


def test_drift_is_smooth_over_frames_and_over_the_image():
    errors = drift_errors(range(3 * DRIFT_KNOT_FRAMES))
    assert np.abs(np.diff(errors, axis=0)).max() < 15 * 0.01 / DRIFT_KNOT_FRAMES
    assert max(np.abs(np.diff(errors, axis=axis)).max() for axis in (1, 2)) < 0.01 / 2
    assert np.abs(errors[-1] - errors[0]).max() > 0.005, "different after some time"


def test_drift_is_proportional_to_depth_and_leaves_holes():
    depth_m = np.zeros((30, 40), np.float32)
    depth_m[:, ::2] = np.linspace(1.0, 6.0, 20)
    read = drifted_depth(depth_m, 77, 1, 0.02)
    assert (read[depth_m == 0] == 0).all() and np.abs(read - depth_m).max() > 0.01
    np.testing.assert_allclose(drifted_depth(2 * depth_m, 77, 1, 0.02), 2 * read, rtol=1e-6)


def test_drift_changes_only_depth_and_is_independent_of_order():
    options = {"frames": 12, "width": 64, "height": 48, "rooms": 2, "overrun": 20}
    plain_room, room = SyntheticRoom(**options), SyntheticRoom(**options, drift=6)
    for i in (7, 2):
        without, drifting = plain_room.frame(i), SyntheticRoom(**options, drift=6).frame(i)
        assert drifting.color.tobytes() == without.color.tobytes()
        assert drifting.depth_m.tobytes() == drifted_depth(without.depth_m, i, 0, 0.006).tobytes()
        assert drifting.depth_m.tobytes() == room.frame(i).depth_m.tobytes()
    assert np.array_equal(room.truth().T_world_camera, plain_room.truth().T_world_camera)


def test_depths_of_a_revisit_agree_well_enough_for_a_loop():
    """Depths agree within 5 cm or 5 %, which loop registration requires."""
    for seed in range(40):
        first, last = drift_errors([60, 660], seed, 0.006)
        assert (np.abs(first - last) < 0.05).mean() > 0.98


def test_an_overrun_repeats_the_start_of_the_path():
    for rooms, pace in [(1, 200), (2, 600), (3, 900)]:
        turn, walk = camera_path(pace + 1, 1, rooms, 1), camera_path(round(1.25 * pace) + 1, 1, rooms, 1, overrun=0.25)
        np.testing.assert_allclose(walk[: pace + 1], turn, atol=1e-9)
        np.testing.assert_allclose(walk[pace:], turn[: pace // 4 + 1], atol=1e-9)


@pytest.mark.parametrize(("options", "frame", "position_m", "depth_m", "color"), GOLDEN)
def test_sequences_do_not_change_between_versions(options, frame, position_m, depth_m, color):
    """Reported results depend on these sequences: a few pixels, stored when the options were added."""
    room = open_source(f"synthetic:width=64,height=48,{options}")
    seen = room.frame(frame)
    np.testing.assert_allclose(room.truth().T_world_camera[frame][:3, 3], position_m, atol=1e-6)
    np.testing.assert_allclose(seen.depth_m[::20, ::25].ravel(), depth_m, atol=2e-4)
    np.testing.assert_allclose(255 * seen.color[24, ::25].ravel(), color, atol=1.01)


def test_texture_noise_is_smooth_and_fades_under_large_pixels():
    u = np.linspace(-2, 2, 4001, dtype=np.float32)
    fine = noise(u, 0.3 * u, np.full_like(u, 1e-4), 0.1, seed=1)
    assert np.abs(np.diff(fine)).max() < 0.05 and fine.std() > 0.2 and np.abs(fine).max() <= 1
    assert np.abs(noise(u, u, np.full_like(u, 0.1), 0.1, seed=1)).max() == 0


def test_the_exact_depth_has_neither_noise_nor_drift():
    noisy = SyntheticRoom(frames=20, width=64, height=48, noise=True, drift=6)
    plain_room = SyntheticRoom(frames=20, width=64, height=48)
    np.testing.assert_array_equal(noisy.exact_depth_of(7), plain_room.frame(7).depth_m)
    assert not np.array_equal(noisy.frame(7).depth_m, noisy.exact_depth_of(7))
    part = open_source("synthetic:frames=20,width=64,height=48,noise=1", InputConfig(stride=7))
    np.testing.assert_array_equal(part.exact_depth_of(1), plain_room.exact_depth_of(7))


def test_test_views_are_exact_and_away_from_the_path():
    room = SyntheticRoom(frames=50, width=64, height=48, noise=True, test_views=5)
    away = room.test_views()
    assert room.truth().T_world_camera.shape == (50, 4, 4) and len(away) == 5
    poses, path = away.truth().T_world_camera, room.truth().T_world_camera
    distance_m = np.linalg.norm(poses[:, None, :3, 3] - path[None, :, :3, 3], axis=2).min(1)
    assert distance_m.max() > 0.1 and distance_m.max() < 0.7
    for i in range(5):
        color, depth_m = render_scene(build_scene(1, 0), room.camera, poses[i])
        np.testing.assert_array_equal(away.frame(i).depth_m, depth_m)
        np.testing.assert_allclose(away.frame(i).color, np.clip(color, 0, 1), atol=0.5001 / 255)
        assert depth_m.min() > 0.3, "nothing is close to the camera"
    again = SyntheticRoom(frames=50, width=64, height=48, test_views=5).test_views().truth()
    np.testing.assert_array_equal(again.T_world_camera, poses)


def test_without_the_option_there_are_no_test_views():
    assert SyntheticRoom(frames=2, width=16, height=12).test_views() is None


def test_negative_options_are_refused():
    for option in ["drift", "overrun", "seed"]:
        with pytest.raises(SourceError, match=f"{option} must be at least 0, found -1"):
            open_source(f"synthetic:frames=7,{option}=-1")


def test_options_in_the_path():
    source = open_source("synthetic:frames=7,width=40,height=30,seed=2,noise=1", stride=2)
    assert (len(source), source.camera.width, source.camera.height) == (4, 40, 30)
    assert open_source("synthetic", limit=3).truth().timestamps_s[1] == pytest.approx(1 / 30)


def test_predicted_depth_has_a_smooth_error_of_scale_and_noise_at_each_pixel() -> None:
    room = SyntheticRoom(frames=4, width=80, height=60, predicted=True)
    depth_m, exact_m = room.frame(2).depth_m, room.exact_depth_of(2)
    ratio = depth_m[exact_m > 0] / exact_m[exact_m > 0]
    assert 0.08 < ratio.std() < 0.2 and 0.7 < ratio.mean() < 1.3
    following = room.frame(3).depth_m[exact_m > 0] / room.exact_depth_of(3)[exact_m > 0]
    assert abs(following.mean() - ratio.mean()) < 0.01, "the error of scale changes slowly"
    assert np.array_equal(depth_m, open_source("synthetic:frames=4,width=80,height=60,predicted=1").frame(2).depth_m)
    with pytest.raises(SourceError, match="predicted or stereo"):
        SyntheticRoom(predicted=True, stereo=10)
