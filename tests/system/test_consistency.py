"""CG-SLAM's ways through the whole of SLAM, on a few small frames: accuracy, bytes, a window of several keyframes."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override
from sigmasplat.plugins.evaluation.metrics.image import psnr
from sigmasplat.plugins.evaluation.metrics.trajectory import ate
from sigmasplat.render import render
from sigmasplat.system.slam import Slam
from small_room import SMALL, frames, walk

pytest.importorskip("sigmasplat.native._core", reason="the kernels are not built (make test builds them)")

FRAMES = 16
PAPER = SMALL | {"mapping.every": "5", "tracking.iterations": "40", "mapping.first_iterations": "100"}


def followed(name: str, changes: dict[str, str]) -> Slam:
    slam = Slam(override(preset(name), changes))
    for frame in frames(FRAMES):
        slam.step(frame)
    return slam


@cache
def followed_once(name: str, changes: tuple[tuple[str, str], ...]) -> Slam:
    """Return a run that several tests look at."""
    return followed(name, dict(changes))


def shown_db(slam: Slam) -> float:
    """Compare the last frame between two keyframes with the map seen from where it was tracked."""
    mapped = [s.index for s in slam.steps if s.is_keyframe]
    step = next(s for s in reversed(slam.steps[: mapped[-1]]) if not s.is_keyframe)
    frame = frames(FRAMES)[step.index]
    T_camera_world = np.linalg.inv(slam.trajectory().T_world_camera[step.index])
    seen = render(slam.field, frame.camera, T_camera_world, options=slam.config.render).color.detach().numpy()
    return float(psnr(seen, frame.color, frame.depth_m > 0))


RUNS: list[Any] = [
    pytest.param("cgslam-fast", SMALL, 0.004, 26.0, id="fast"),
    pytest.param("sigma", SMALL, 0.004, 26.0, id="sigma"),
    pytest.param("cgslam-replica", PAPER, 0.02, 24.0, id="paper", marks=pytest.mark.slow),
    pytest.param("cgslam-fast", SMALL | {"mapping.adjustment": "window-newest"}, 0.004, 26.0, id="by-descriptor"),
    pytest.param(
        "cgslam-released-replica",
        PAPER,
        0.02,
        24.0,
        id="released",
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize(("name", "changes", "ate_m", "least_db"), RUNS)
def test_the_path_is_followed_and_the_room_shown(
    name: str, changes: dict[str, str], ate_m: float, least_db: float
) -> None:
    slam = followed_once(name, tuple(changes.items()))
    assert not any(step.lost for step in slam.steps)
    assert ate(slam.trajectory(), walk().truth()).rmse_m < ate_m
    assert shown_db(slam) > least_db
    assert torch.isfinite(slam.field.params).all()


@pytest.mark.parametrize(
    ("name", "changes"), [pytest.param("cgslam-replica", PAPER, marks=pytest.mark.slow), ("sigma", SMALL)]
)
def test_same_input_same_bytes(name: str, changes: dict[str, str]) -> None:
    first, second = followed_once(name, tuple(changes.items())).checkpoint(), followed(name, changes).checkpoint()
    assert all(first[key].numpy().tobytes() == second[key].numpy().tobytes() for key in first)


def test_loops_and_submaps_go_with_a_consistent_field() -> None:
    """Cut often: poses and splats go on from submap to submap, and the final map is refined by the same terms."""
    slam = followed("cgslam-loops-fast", SMALL | {"submaps.frames": "4", "final.iterations": "40"})
    slam.finish()
    assert len(slam.store) >= 3 and not any(step.lost for step in slam.steps)
    assert ate(slam.trajectory(), walk().truth()).rmse_m < 0.005
    assert shown_db(slam) > 22.0
