"""When a lost camera may map again, when a new map begins, and which observations join two maps."""

import numpy as np
import pytest
from numpy.typing import NDArray

from paper_settings import RecoveryConfig
from sigmasplat.data import se3
from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Detail, Frame
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.target import Target
from sigmasplat.tracking.feature_image import FeatureImage
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.recovery import Link, Recovery, usable

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

CAMERA = Camera(40, 30, 32.0, 32.0, 19.5, 14.5)
SURE = np.eye(6)


def sight(share_with_depth: float = 1.0, contrast: float = 0.3) -> PreparedFrame:
    color = np.random.default_rng(0).uniform(0.5 - contrast, 0.5 + contrast, (30, 40, 3)).astype(np.float32)
    depth = np.full(30 * 40, 2.0, np.float32)
    depth[int(share_with_depth * depth.size) :] = 0.0
    frame = Frame(0, 0.0, color, depth.reshape(30, 40), CAMERA)
    gray = np.rint(255 * color[..., 0]).astype(np.uint8)
    live = Pyramid.of(color[..., 0], frame.depth_m, CAMERA)
    image = FeatureImage(Detail(gray, CAMERA), frame.depth_m, CAMERA)
    return PreparedFrame(Target.of(frame, (32, 48)), live, image, frame=frame, whole=frame)


SEEN, BLACK = sight(), sight(0.0, 0.0)


def recovery(**changes: int) -> Recovery:
    return Recovery(RecoveryConfig(**{"steady_frames": 2, "new_map_after": 3, **changes}))


def test_an_image_without_depth_or_without_contrast_is_of_no_use() -> None:
    assert usable(SEEN) and usable(sight(0.1))
    assert not usable(BLACK) and not usable(sight(0.02)) and not usable(sight(1.0, 0.001))


def test_an_undisturbed_camera_may_map_from_the_beginning() -> None:
    r = recovery()
    assert r.is_steady and not r.gives_up
    r.count(False, True, SEEN)
    assert r.is_steady, "a single doubtful frame is not a loss"


def test_after_a_loss_the_camera_must_be_steady_before_it_maps() -> None:
    r = recovery()
    r.count(True, True, SEEN)
    steady = []
    for doubtful in (False, True, False, False, False):
        r.count(False, doubtful, SEEN)
        steady.append(r.is_steady)
    assert steady == [False, False, False, True, True], "a doubtful frame restarts the count"


def test_a_new_map_begins_after_enough_lost_frames_in_a_row() -> None:
    r = recovery()
    r.count(True, True, SEEN)
    r.count(True, True, SEEN)
    assert not r.gives_up
    r.count(False, False, SEEN)
    for _ in range(2):
        r.count(True, True, SEEN)
    assert not r.gives_up, "the frame in between was tracked"
    r.count(True, True, SEEN)
    assert r.gives_up
    r.found()
    assert not r.gives_up and not r.is_steady


def test_black_frames_neither_begin_a_map_nor_end_the_count() -> None:
    r = recovery()
    for seen in (SEEN, *[BLACK] * 50, SEEN):
        r.count(True, True, seen)
    assert not r.gives_up
    r.count(True, True, SEEN)
    assert r.gives_up


def test_no_new_map_begins_if_it_is_switched_off() -> None:
    r = recovery(new_map_after=0)
    for _ in range(100):
        r.count(True, True, SEEN)
    assert not r.gives_up


# ---- observations that join


def motion(seed: int) -> NDArray[np.float64]:
    return se3.exp(np.random.default_rng(seed).normal(0.0, 0.5, 6))


TRUE = motion(99)
"""The frame of component 1 in the world."""


@pytest.fixture
def atlas() -> Atlas:
    """Return three components: submaps 0, 1 and 2, 3 and 4."""
    made = Atlas()
    for k, pose in enumerate((None, motion(1), None, motion(2), None)):
        made.begin_submap(pose, k - 1)
    return made


def link(atlas: Atlas, a: int, b: int, off: NDArray[np.float64] | None = None) -> Link:
    """Return an observation of the true pose between two submaps of components 0 and 1, or one that is off."""
    world = [anchor if atlas.components[s] == 0 else TRUE @ anchor for s, anchor in enumerate(atlas.anchors)]
    T_a_b = se3.inverse(world[a]) @ world[b] @ (np.eye(4) if off is None else off)
    return Link(a, b, T_a_b, SURE)


def test_one_observation_joins_nothing_and_a_second_that_agrees_joins(atlas: Atlas) -> None:
    for a, b in ((1, 3), (0, 2), (1, 2), (3, 0), (2, 1)):  # other submaps, and from the other side
        r = recovery()
        assert not r.confirms(link(atlas, 0, 3), atlas)
        assert r.confirms(link(atlas, a, b), atlas), (a, b)


@pytest.mark.parametrize(
    ("off", "joins"),
    [
        (se3.exp(np.array([0.05, 0, 0, 0, 0, 0])), True),
        (se3.exp(np.array([0.2, 0, 0, 0, 0, 0])), False),
        (se3.exp(np.array([0, 0, 0, 0, np.deg2rad(10.0), 0])), False),
        (se3.exp(np.array([0, 3.0, 0, 0, 0, 2.0])), False),
    ],
    ids=["a little", "by 20 cm", "by 10 degrees", "elsewhere"],
)
def test_observations_that_contradict_each_other_do_not_join(
    atlas: Atlas, off: NDArray[np.float64], joins: bool
) -> None:
    r = recovery()
    r.confirms(link(atlas, 1, 3), atlas)
    assert r.confirms(link(atlas, 1, 3, off), atlas) == joins


def test_after_a_false_observation_two_true_ones_are_needed(atlas: Atlas) -> None:
    false, r = se3.exp(np.array([1.0, 0, 0, 0, 1.0, 0])), recovery()
    verdicts = [r.confirms(link(atlas, 1, 2, off), atlas) for off in (None, false, None, None)]
    assert verdicts == [False, False, False, True]


def test_observations_of_different_components_do_not_join(atlas: Atlas) -> None:
    r = recovery()
    assert not r.confirms(link(atlas, 1, 3), atlas)
    assert not r.confirms(Link(1, 4, link(atlas, 1, 3).T_a_b, SURE), atlas)
    assert not r.confirms(link(atlas, 1, 3), atlas), "the observation in between was of another component"
