"""What moves is masked in keyframes and carved out of the map; masks of the user are refused if they do not fit."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from paper_settings import MovingConfig
from sigmasplat.config import RenderConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import Picture
from sigmasplat.errors import SourceError
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.moving import carve, mask_keyframes
from sigmasplat.plugins.sources import SyntheticRoom, open_source
from sigmasplat.render.backend import make_view
from sigmasplat.tracking.moving.dynamic_detector import DynamicDetector
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.prepared_frame import PreparedFrame

CAMERA = Camera(160, 120, 140.0, 140.0, 79.5, 59.5)
WALL_M, BOX_M, FRAMES = 3.0, 1.0, 30
VIEW = make_view("cpu", CAMERA, RenderConfig())


def with_box(left: int) -> NDArray[np.float32]:
    """Return the depth of a wall with a box in front of it, from column `left` on."""
    depth_m = np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)
    depth_m[40:90, left : left + 40] = BOX_M
    return depth_m


def keyframe(index: int, depth_m: NDArray[np.float32]) -> Keyframe:
    color = np.full((*depth_m.shape, 3), 0.5, np.float32)
    return Keyframe(index, Target.of(Frame(index, 0.0, color, depth_m, CAMERA), depth_m.shape), np.eye(4))


def masked(frame: Keyframe) -> NDArray[np.bool_]:
    return np.asarray(frame.target.depth_image.numpy() == 0)


def test_a_box_that_moves_by_less_than_its_width_is_masked_in_both_keyframes() -> None:
    frames = [keyframe(0, with_box(40)), keyframe(5, with_box(60))]
    mask_keyframes(frames, MovingConfig(find=True, still_frames=FRAMES))
    for frame, left in zip(frames, (40, 60), strict=True):
        box = with_box(left) == BOX_M
        assert masked(frame)[box].mean() > 0.95 and masked(frame)[~box].mean() < 0.1


def test_what_came_long_ago_and_stayed_is_not_masked() -> None:
    frames = [keyframe(0, with_box(200)), keyframe(FRAMES + 5, with_box(60))]
    mask_keyframes(frames, MovingConfig(find=True, still_frames=FRAMES))
    assert not masked(frames[0]).any() and not masked(frames[1]).any()


def test_splats_in_free_space_are_carved_but_not_those_that_a_keyframe_shows() -> None:
    floating, on_box, on_wall = (0.0, 0.0, 1.5), (0.2, 0.0, 1.0), (0.0, 0.0, 3.02)
    points = torch.tensor([floating, on_box, on_wall])
    field = GaussianField.from_values(points, torch.full((3, 3), 0.02), torch.full((3, 3), 0.5))
    frames = [keyframe(0, with_box(90)), *(keyframe(n, with_box(200)) for n in (5, 10, 15))]
    carve(field, frames, votes=3)
    assert field.means[:, 2].tolist() == pytest.approx([1.0, 3.02])


def thing(depth_m: NDArray[np.float32]) -> DynamicMask:
    """Return the box of `with_box` as what is in front."""
    box = depth_m == BOX_M
    return DynamicMask(box, np.where(box, depth_m, np.float32(0.0)), np.full_like(depth_m, WALL_M))


def test_rest_ends_motion() -> None:
    memory, found = DynamicDetector(MovingConfig(find=True, still_frames=FRAMES)), list[bool]()
    for n in range(80):
        depth_m = with_box(min(20 + n, 60))
        found.append(memory.still_moving(thing(depth_m), depth_m, np.eye(4), CAMERA) is not None)
        memory = memory.after(depth_m, np.eye(4))
    assert all(found[:45]) and not any(found[75:])


def test_what_comes_back_to_an_earlier_place_is_not_at_rest() -> None:
    memory, left = DynamicDetector(MovingConfig(find=True, still_frames=FRAMES)), [60] * 11 + [110] * 10 + [60] * 20
    moved, found = with_box(60) == BOX_M, None
    for n, column in enumerate(left):
        depth_m = with_box(column)
        found = memory.still_moving(thing(depth_m), depth_m, np.eye(4), CAMERA)
        assert found is not None, f"frame {n} is taken for at rest"
        memory = memory.after(depth_m, np.eye(4))
    assert found is not None and found.hidden[moved].all()


@pytest.mark.parametrize(("floating", "left"), [(1, 2001), (20, 2000)])
def test_a_stray_splat_is_not_taken_for_a_thing_that_has_gone(floating: int, left: int) -> None:
    points = torch.tensor([(0.0, 0.0, 3.0)] * 2000 + [(0.0, 0.0, 1.5)] * floating)
    field = GaussianField.from_values(points, torch.full_like(points, 0.02), torch.full_like(points, 0.5))
    carve(field, [keyframe(n, with_box(200)) for n in (0, 5, 10)], votes=3)
    assert len(field) == left


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_what_a_distance_means_grows_with_the_scene(scale: float) -> None:
    """A step of 8 cm at 1 m shows nothing that moves, nor one of 80 cm at 10 m in a scene ten times as large."""
    near, far = with_box(60), with_box(200)
    for depth_m in (near, far):
        depth_m[:] = np.where(depth_m == BOX_M, scale, 1.08 * scale)
    frames, config = [keyframe(0, near), keyframe(5, far)], MovingConfig(find=True, still_frames=FRAMES)
    mask_keyframes(frames, config, scale)
    assert not any(masked(frame).any() for frame in frames)
    points = torch.tensor([(0.0, 0.0, scale)] * 100)
    field = GaussianField.from_values(points, torch.full_like(points, 0.02), torch.full_like(points, 0.5))
    carve(field, [keyframe(n, far) for n in (0, 5, 10)], 3, scale)
    assert len(field) == len(points)
    before, live = (PreparedFrame.of_picture(Picture(np.zeros((120, 160, 3), np.uint8), z), VIEW) for z in (near, far))
    reference = Reference(before.live, np.eye(4))
    assert DynamicDetector(config, scale).without_gone(reference, live, np.eye(4)) is reference


def test_nothing_moves_in_noise() -> None:
    noise, frames = np.random.default_rng(0), list[Keyframe]()
    for n in range(4):
        frames.append(keyframe(n, with_box(60) + noise.normal(0, 0.01, (120, 160)).astype(np.float32)))
        mask_keyframes(frames, MovingConfig(find=True))
    assert not any(masked(frame).any() for frame in frames)


def test_the_ball_of_the_synthetic_room_covers_its_share_and_hides_nothing_else() -> None:
    room = SyntheticRoom(frames=60, width=80, height=60, mover=20)
    shares = [room.moving_of(i).mean() for i in range(0, 60, 15)]
    assert 0.1 < np.mean(shares) < 0.3
    still = SyntheticRoom(frames=60, width=80, height=60).exact_depth_of(30)
    ball = room.moving_of(30)
    np.testing.assert_array_equal(room.exact_depth_of(30)[~ball], still[~ball])
    assert (room.exact_depth_of(30)[ball] < still[ball]).all()
    with pytest.raises(SourceError, match="rooms=1"):
        SyntheticRoom(mover=20, rooms=2)


def write_masks(folder: Path, count: int, size: tuple[int, int]) -> Path:
    folder.mkdir()
    for i in range(count):
        mask = np.zeros(size[::-1], np.uint8)
        mask[:, : size[0] // 2] = 1
        Image.fromarray(mask).save(folder / f"{i}.png")
    return folder


def test_masked_pixels_have_no_depth_also_in_a_part_of_the_sequence(tmp_path: Path) -> None:
    folder = write_masks(tmp_path / "masks", 3, (40, 30))
    source = open_source("synthetic:frames=3,width=80,height=60", masks=str(folder), limit=2)
    frame = source.frame(1)
    assert not frame.depth_m[:, :40].any() and (frame.depth_m[:, 40:] > 0).all()
    assert frame.ignored is not None and frame.ignored[:, :40].all() and not frame.ignored[:, 40:].any()


@pytest.mark.parametrize(
    ("count", "size", "said"), [(2, (40, 30), "2 masks for 3 frames"), (3, (30, 30), "the images")]
)
def test_masks_that_do_not_fit_are_refused(tmp_path: Path, count: int, size: tuple[int, int], said: str) -> None:
    folder = write_masks(tmp_path / "masks", count, size)
    with pytest.raises(SourceError, match=said):
        open_source("synthetic:frames=3,width=80,height=60", masks=str(folder))
