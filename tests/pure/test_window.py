"""The sliding window: what keyframes share, by splats and looks, and who is chosen by it."""

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
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.window import choose_window, covisible_splats, dominating
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


def test_descriptors_choose_by_their_similarity() -> None:
    keyframes = [keyframe(k, pose(x=0.6 * k)) for k in range(5)]
    angles = [0.1, 1.2, 0.7, 0.0, 0.0]
    keyframes = [
        replace(k, descriptor=np.float32([np.cos(a), np.sin(a)])) for k, a in zip(keyframes, angles, strict=True)
    ]
    assert indices(choose_window(keyframes, 4, "descriptor")) == [4, 3, 0, 2]


def test_what_is_missing_is_named() -> None:
    keyframes = [keyframe(k) for k in range(3)]
    for by in ("splats", "descriptor"):
        with pytest.raises(AssertionError, match=f"window by {by}"):
            choose_window(keyframes, 3, by)
        assert indices(choose_window(keyframes, 2, by)) == [2, 1]


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
