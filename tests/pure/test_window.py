"""The sliding window: what keyframes share, by splats, readings and looks, and who is chosen by it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from paper_settings import RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.errors import SigmaSplatError
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.window import SCORES, choose_window, covisible_splats, dominating
from sigmasplat.render.reference import ReferenceView

Array = NDArray[np.float64]
CAMERA = Camera(48, 36, 40.0, 42.0, 22.6, 18.3)
PADDED = (48, 64)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw_deg: float = 0.0) -> Array:
    """Place a camera: T_world_camera, turned to the right by `yaw_deg`."""
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(yaw_deg), 0.0]))
    T[:3, 3] = x, y, z
    return T


def keyframe(
    index: int = 0, T_world_camera: Array | None = None, depth_m: Array | float = 2.0, seen: list[int] | None = None
) -> Keyframe:
    depth = np.broadcast_to(np.asarray(depth_m, np.float32), (CAMERA.height, CAMERA.width)).copy()
    target = Target.of(Frame(0, 0.0, np.zeros((*depth.shape, 3), np.float32), depth, CAMERA), PADDED)
    T = np.eye(4) if T_world_camera is None else T_world_camera
    return Keyframe(index, target, T, visible_ids=None if seen is None else np.array(seen, np.int64))


def shared(newest: Keyframe, older: Keyframe) -> float:
    return float(SCORES["frustum"](newest, [older])[0])


def indices(window: list[Keyframe]) -> list[int]:
    return [k.index for k in window]


def test_splats_in_common_are_counted_as_sets_are() -> None:
    random = np.random.default_rng(0)
    for _ in range(30):
        sets = [np.unique(random.integers(0, 60, random.integers(0, 40))) for _ in range(4)]
        newest, others = sets[0], sets[1:]
        expected = [len(set(newest) & set(other)) / max(len(newest), 1) for other in others]
        np.testing.assert_allclose(covisible_splats(newest, others), expected)


def test_the_share_is_of_the_newest_keyframes_splats() -> None:
    few, many = np.array([3, 5]), np.arange(10)
    assert covisible_splats(few, [many, few, np.array([3, 10**6]), few[:0]]).tolist() == [1.0, 1.0, 0.5, 0.0]
    assert covisible_splats(many, [few]).tolist() == [0.2]
    assert covisible_splats(few[:0], [many, few]).tolist() == [0.0, 0.0]


def test_a_camera_shares_all_readings_with_itself_and_zero_with_an_opposite_one() -> None:
    rough = np.random.default_rng(0).uniform(0.5, 5.0, (CAMERA.height, CAMERA.width))
    rough[::3] = 0.0
    at = pose(1.0, -2.0, 3.0, 30.0)
    assert shared(keyframe(0, at, rough), keyframe(1, at, rough)) == 1.0
    assert shared(keyframe(0, at, rough), keyframe(1, at @ pose(yaw_deg=180.0), rough)) == 0.0
    assert shared(keyframe(0, at, rough), keyframe(1, at @ pose(x=50.0), rough)) == 0.0
    assert shared(keyframe(0, at, rough), keyframe(1, at @ pose(z=6.0), rough)) == 0.0, "all points lie behind it"


def test_a_wall_hides_what_lies_behind_it() -> None:
    far = keyframe(0, depth_m=2.0)
    assert shared(far, keyframe(1, depth_m=1.0)) == 0.0
    assert shared(keyframe(1, depth_m=1.0), far) == 1.0, "but not what lies before it"
    assert shared(far, keyframe(1, depth_m=0.0)) == 1.0, "no reading hides nothing"
    half = np.full((CAMERA.height, CAMERA.width), 2.0)
    half[:, : CAMERA.width // 2] = 1.0
    assert shared(far, keyframe(1, depth_m=half)) == pytest.approx(0.5, abs=0.02)
    assert shared(keyframe(0, depth_m=2.14), keyframe(1, depth_m=2.0)) == 1.0, "within 5 % and 5 cm it is the same wall"
    assert shared(keyframe(0, depth_m=2.16), keyframe(1, depth_m=2.0)) == 0.0


def test_a_sideways_step_loses_the_columns_that_leave_the_image() -> None:
    for shift_px in [0, 6, 24, 47]:
        aside = keyframe(1, pose(x=shift_px * 2.0 / CAMERA.fx))
        for a, b in ((keyframe(0), aside), (aside, keyframe(0))):
            assert shared(a, b) == pytest.approx(1.0 - shift_px / CAMERA.width, abs=1.5 / 40)


def test_readings_in_common_agree_with_a_plain_loop() -> None:
    random = np.random.default_rng(3)
    depths = [random.uniform(1.0, 3.0, (CAMERA.height, CAMERA.width)).astype(np.float32) for _ in range(2)]
    depths[0][random.random(depths[0].shape) < 0.3] = 0.0
    depths[1][random.random(depths[1].shape) < 0.3] = 0.0
    T_world_a, T_world_b = pose(0.2, 0.1, 0.3, 5.0), pose(-0.1, 0.2, -0.2, -8.0)
    seen, total = 0, 0
    for row in range(CAMERA.height):  # all 36 rows, 40 of 48 columns
        for column in sorted({int((k + 0.5) * CAMERA.width / 40) for k in range(40)}):
            d = float(depths[0][row, column])
            if d == 0.0:
                continue
            total += 1
            ray = np.array([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, 1.0, 1.0 / d])
            x, y, z, _ = np.linalg.inv(T_world_b) @ T_world_a @ (ray * d)
            u, v = round(CAMERA.fx * x / z + CAMERA.cx), round(CAMERA.fy * y / z + CAMERA.cy)
            if z > 0 and 0 <= u < CAMERA.width and 0 <= v < CAMERA.height:
                there = float(depths[1][v, u])
                seen += there == 0.0 or z <= 1.05 * there + 0.05
    assert 0.2 < seen / total < 0.9
    found = shared(keyframe(0, T_world_a, depths[0].astype(float)), keyframe(1, T_world_b, depths[1].astype(float)))
    assert found == pytest.approx(seen / total, abs=1e-9)


def test_moving_the_world_changes_no_share_of_readings() -> None:
    a, b, move = pose(), pose(0.4, 0.1, 0.2, 10.0), se3.exp(np.array([3.0, -2.0, 7.0, 0.5, -1.0, 2.0]))
    assert 0.1 < shared(keyframe(0, a), keyframe(1, b)) < 0.95
    assert shared(keyframe(0, move @ a), keyframe(1, move @ b)) == shared(keyframe(0, a), keyframe(1, b))


def test_no_readings_no_share() -> None:
    assert shared(keyframe(0, depth_m=0.0), keyframe(1)) == 0.0


def with_shares(shares: list[float]) -> list[Keyframe]:
    """Make keyframes whose splats share so much with the last one's."""
    return [keyframe(k, seen=list(range(round(10 * share)))) for k, share in enumerate([*shares, 1.0])]


def test_the_newest_the_one_before_and_the_best_of_the_others() -> None:
    keyframes = with_shares([0.3, 0.9, 0.1, 0.6, 0.0])
    assert indices(choose_window(keyframes, 1, "splats")) == [5]
    assert indices(choose_window(keyframes, 2, "splats")) == [5, 4]
    assert indices(choose_window(keyframes, 3, "splats")) == [5, 4, 1]
    assert indices(choose_window(keyframes, 4, "splats")) == [5, 4, 1, 3]
    assert indices(choose_window(keyframes, 99, "splats")) == [5, 4, 1, 3, 0, 2]


def test_of_equals_the_later_keyframe() -> None:
    keyframes = with_shares([0.5, 0.0, 0.5, 0.8, 0.5, 0.0, 0.2])
    assert indices(choose_window(keyframes, 5, "splats")) == [7, 6, 3, 4, 2]
    assert indices(choose_window(keyframes, 8, "splats")) == [7, 6, 3, 4, 2, 0, 5, 1]


def test_a_window_is_small_while_keyframes_are_few() -> None:
    for count in [0, 1, 2, 3]:
        keyframes = with_shares([0.5, 0.5, 0.5])[-count:] if count else []
        assert indices(choose_window(keyframes, 4, "splats")) == [3, 2, 1][:count]


def test_frustum_and_descriptor_choose_by_what_they_compare() -> None:
    keyframes = [keyframe(k, pose(x=0.6 * k)) for k in range(5)]
    angles = [0.1, 1.2, 0.7, 0.0, 0.0]
    keyframes = [
        replace(k, descriptor=np.float32([np.cos(a), np.sin(a)])) for k, a in zip(keyframes, angles, strict=True)
    ]
    assert indices(choose_window(keyframes, 4, "frustum")) == [4, 3, 2, 1]
    assert indices(choose_window(keyframes, 4, "descriptor")) == [4, 3, 0, 2]


def test_what_is_missing_is_named() -> None:
    keyframes = [keyframe(k) for k in range(3)]
    for by in ("splats", "descriptor"):
        with pytest.raises(SigmaSplatError, match=f"keyframe [02] .*covisibility={by}"):
            choose_window(keyframes, 3, by)  # type: ignore[arg-type]
        assert indices(choose_window(keyframes, 2, by)) == [2, 1]  # type: ignore[arg-type]
    assert len(choose_window(keyframes, 3, "frustum")) == 3


def test_splats_that_dominate_are_named_by_their_ids() -> None:
    means = torch.tensor([[-0.5, 0.0, 2.0], [0.4, 0.0, 2.5], [0.4, 0.0, 2.0], [0.0, 0.0, -2.0], [0.0, 0.4, 2.0]])
    field = GaussianField.from_values(means, torch.full((5,), 0.1), torch.rand(5, 3), opacities=0.9)
    field.keep(torch.tensor([4, 1, 2, 3, 0]))
    field.ids += 100
    view = ReferenceView(CAMERA, RenderConfig())
    view.forward(field.params, np.eye(4), layers=True)
    found = dominating(view, field)
    assert found.dtype == np.int64 and {100, 102, 104} <= set(found.tolist()) and 103 not in found
    assert (np.diff(found) > 0).all()
    ids = view.layers.dominant_id.numpy()
    assert found.tolist() == sorted({int(field.ids[row]) for row in ids.ravel() if row >= 0})


def test_padding_is_not_seen() -> None:
    pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built")
    from sigmasplat.render.cpu import CpuView

    wide = Camera(40, 30, 40.0, 42.0, 22.6, 18.3)
    random = np.random.default_rng(0)
    means = torch.from_numpy(random.uniform([-2, -2, 1], [2, 2, 3], (300, 3))).float()
    field = GaussianField.from_values(means, torch.full((300,), 0.1), torch.rand(300, 3), opacities=0.8)
    compiled, plain = CpuView(wide, RenderConfig()), ReferenceView(wide, RenderConfig())
    assert compiled.alpha.shape != plain.alpha.shape
    for view in (compiled, plain):
        view.forward(field.params, np.eye(4), layers=True)
    assert dominating(compiled, field).tolist() == dominating(plain, field).tolist()


def test_an_empty_field_is_seen_by_nobody() -> None:
    view = ReferenceView(CAMERA, RenderConfig())
    view.layers.dominant_id.fill_(-1)
    assert dominating(view, GaussianField.empty()).tolist() == []
