"""A sequence whose camera poses are known: they are used as they are, and no frame is tracked."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import RECORDED_POSES, InputConfig
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.input.association import MAX_GAP_S, associate
from sigmasplat.input.given_poses import ByName, ByNumber, read_given_poses
from sigmasplat.input.source import Source, Subset
from sigmasplat.types import Matrix


class Posed(Subset):
    """Another source with a pose for each frame; frames without one are left out.

    given: the path of the poses, or "recorded" for those that the device estimated itself; scale: factor from their
    unit to metres; depth_scale: factor from predicted depth, whose scale is arbitrary, to metres. Raises SourceError if
    the poses do not fit the frames, or the source is a live camera.
    """

    def __init__(self, whole: Source, given: str, scale: float = 1.0, depth_scale: float = 1.0) -> None:
        if whole.live:
            raise SourceError(f"{given}: poses are for recordings only; record the camera, then run the recording")
        super().__init__(whole, InputConfig())
        found = _poses_of(whole, given)
        self._depth_scale = np.float32(depth_scale if whole.predicted_depth else 1.0)
        self._poses = [_scaled(T, scale) for T in found if T is not None]
        self._indices = [i for i, T in enumerate(found) if T is not None]
        self.skipped += [f"{whole.name}, frame {i}: no pose in {given}" for i, T in enumerate(found) if T is None]

    def frame(self, i: int) -> Frame:
        """Read frame i with its pose, and predicted depth in the unit of the poses."""
        frame = super().frame(i)
        depth_m = frame.depth_m if self._depth_scale == 1.0 else frame.depth_m * self._depth_scale
        return replace(frame, depth_m=depth_m, T_given_camera=self._poses[i])

    def depth_of(self, i: int) -> NDArray[np.float32]:
        """Read the depth of frame i, in the unit of the poses if it is predicted."""
        return super().depth_of(i) * self._depth_scale


def _scaled(T: Matrix, scale: float) -> Matrix:
    """Return a pose whose position is multiplied by a factor."""
    T = T.copy()
    T[:3, 3] *= scale
    return T


def _poses_of(whole: Source, given: str) -> list[Matrix | None]:
    """Return T_world_camera [4, 4] of each frame, None without one. Raises SourceError if no frame has one."""
    poses = _recorded(whole) if given == RECORDED_POSES else read_given_poses(Path(given))
    if isinstance(poses, Trajectory):
        return _by_time(whole, given, poses)
    if isinstance(poses, ByNumber):
        return _by_number(whole, given, poses.poses)
    return _by_name(whole, given, poses)


def _recorded(whole: Source) -> Trajectory:
    path = whole.device_path()
    if path is None:
        raise SourceError(
            f"{whole.name}: the recording has no poses that its device estimated; give a file of poses, or leave "
            "out input.poses: then poses are estimated"
        )
    return path


def _by_time(whole: Source, given: str, path: Trajectory) -> list[Matrix | None]:
    times_s = np.array([whole.timestamp_s(i) for i in range(len(whole))])
    found: list[Matrix | None] = [None] * len(whole)
    for i, row in associate(times_s, path.timestamps_s):
        found[i] = path.T_world_camera[row]
    if not any(T is not None for T in found):
        raise SourceError(
            f"{given}: no pose is within {MAX_GAP_S:g} s of a frame (poses {path.timestamps_s.min():.3f} … "
            f"{path.timestamps_s.max():.3f} s, frames {times_s.min():.3f} … {times_s.max():.3f} s); "
            "use the clock of the recording, in seconds"
        )
    return found


def _by_number(whole: Source, given: str, poses: Sequence[Matrix | None]) -> list[Matrix | None]:
    if len(poses) != len(whole):
        raise SourceError(
            f"{given}: found {len(poses)} poses for {len(whole)} frames; give one for each frame, in order"
        )
    if not any(T is not None for T in poses):
        raise SourceError(f"{given}: no pose is finite; give at least one finite pose")
    return list(poses)


def _by_name(whole: Source, given: str, poses: ByName) -> list[Matrix | None]:
    names = [Path(whole.image_name(i)).stem for i in range(len(whole))]
    found = [poses.poses.get(name) for name in names]
    if not any(T is not None for T in found):
        has = f"images are named as {names[0]}" if names[0] else "the recording has no names of images"
        raise SourceError(
            f"{given}: no pose has the name of an image (poses are named as {next(iter(poses.poses))}, {has}); "
            "use the names of the recording's colour images, or give TUM text"
        )
    return found
