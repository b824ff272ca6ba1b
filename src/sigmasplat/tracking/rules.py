"""Decide by rules: small functions that answer yes or no, or choose from a list."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import SubmapConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.fit.pose import PoseFit

Item = TypeVar("Item")
ShouldStop = Callable[[], bool]
"""Asked again and again during long work."""
WIDE = 0.065
"""A motion between two frames is wide if it moves the image by more than this share of its width: the basin of
convergence of alignment ends near there."""


def never() -> bool:
    """Return False."""
    return False


def is_keyframe(frames_since: int, every: int, overlap: float, overlap_below: float) -> bool:
    """Return whether to map a frame: `every` frames after the last keyframe (VarSplat §2), or when the overlap is
    low."""
    return frames_since >= every or overlap < overlap_below


def has_moved(T_keyframe_camera: NDArray[np.float64], depth_m: float, most_deg: float) -> bool:
    """Return whether the image has moved by more than an angle since the last keyframe."""
    return bool(np.rad2deg(angle_between(np.eye(4), T_keyframe_camera, depth_m)) > most_deg)


def angle_between(T_one: NDArray[np.float64], T_other: NDArray[np.float64], depth_m: float) -> float:
    """Return by how much the image of one camera has moved in the other, rad: rotation plus translation divided by the
    mean depth; T_one, T_other [4, 4]: poses of the cameras."""
    moved_m = float(np.linalg.norm(T_other[:3, 3] - T_one[:3, 3]))
    return se3.rotation_angle(T_one[:3, :3].T @ T_other[:3, :3]) + moved_m / depth_m


def is_held_back(index: int, every: int) -> bool:
    """Return whether a frame is held back from the map: the last one of each `every` frames; 0 = none."""
    return every > 0 and index % every == every - 1


def ends_submap(
    T_submap_camera: NDArray[np.float64], frames_since: int, uncertainty_m: float, config: SubmapConfig
) -> str:
    """Return the name of the rule that ends the active submap at this keyframe, or "" if none does (VarSplat §2).

    frames_since: frames since the submap began; uncertainty_m: `Drift.position_m` of the keyframe.
    """
    c = config
    found = {
        "distance": (float(np.linalg.norm(T_submap_camera[:3, 3])), c.distance_m),
        "angle": (float(np.rad2deg(se3.rotation_angle(T_submap_camera[:3, :3]))), c.angle_deg),
        "frames": (float(frames_since), c.frames - 1e-9 if c.frames else 0.0),
        "uncertainty": (uncertainty_m, c.uncertainty_m),
    }
    return next((rule for rule, (value, limit) in found.items() if limit and value > limit), "")


def is_wide(T_previous: NDArray[np.float64], fit: PoseFit, camera: Camera, has_features: bool) -> bool:
    """Return whether a frame is so far from the last one, at T_previous [4, 4], that a second guess by features is
    worth its time."""
    depth_m = fit.alignment.depth_m if fit.alignment is not None else 1.0
    moved = angle_between(T_previous, se3.inverse(fit.T_camera_world), depth_m) if has_features else 0.0
    return moved * camera.fx > WIDE * camera.width


def is_lost(fit: PoseFit, least_agreement: float, least_share: float) -> bool:
    """Return whether tracking failed: the depths of map and sensor disagree, or too few pixels are in common."""
    return fit.agreement < least_agreement or fit.agreement * fit.overlap < least_share


def jumped(value: float, history: Sequence[float], factor: float) -> bool:
    """Return whether a loss exceeds `factor` times the median of the recent losses (VarSplat §3, re-initialisation)."""
    return len(history) >= 5 and value > factor * float(np.median(history[-50:]))


def draw_keyframes(
    keyframes: Sequence[Item],
    iterations: int,
    newest_probability: float,
    random: np.random.Generator,
    together: int = 1,
) -> Iterator[list[Item]]:
    """Draw keyframes for each iteration: the newest with the given probability, else a random older one (VarSplat §2).

    together > 1: draw that many different keyframes,
    or all of them if there are fewer (CG-SLAM §7).
    """
    everything = list(keyframes)
    older = everything[:-1]
    for _ in range(iterations):
        if together >= len(everything) > 1:
            yield everything
            continue
        newest = not older or random.random() < newest_probability
        drawn = [len(older)] if newest else [int(random.integers(len(older)))]
        if together > 1:
            others = [i for i in range(len(everything)) if i != drawn[0]]
            drawn += [int(i) for i in random.choice(others, min(together - 1, len(others)), replace=False)]
        yield [everything[i] for i in drawn]


def unless(should_stop: ShouldStop, guesses: Iterable[Item], least: int = 0) -> Iterator[Item]:
    """Yield guesses while `should_stop` returns False, at least the first `least` ones; a guess is not made before it
    is asked."""
    waiting = iter(guesses)
    yield from islice(waiting, least)
    while not should_stop():
        try:
            yield next(waiting)
        except StopIteration:
            return
