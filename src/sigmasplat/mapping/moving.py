"""Keep what moves out of the map: compare keyframes with each other, and remove splats from space that is free.

Two keyframes contradict each other where one shows a surface in space that the other one sees through. If the other one
is later, the surface has gone: it is masked in the earlier one. If it is earlier, the surface has come; it is masked in
the later one if both are so close in time that it may still be moving. Masked pixels have no depth.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.config import MovingConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.fit.target import Keyframe
from sigmasplat.tracking.moving.dynamic_mask import Earlier, coarse_step, dynamic_mask
from sigmasplat.tracking.moving.free_space import CLEAR_M, CLEAR_RELATIVE, Depth, Mask, free_places, on_image
from sigmasplat.types import Matrix

SUPPORT = 4
"""A splat stays if a surface at its place was seen at least once for this many times that the place was free."""

STRAY = 0.001
"""Splats are removed if they are at least this share of the map: a few in free space are errors of depth."""
SAMPLED = 4
"""Every fourth splat tells whether so many are in free space."""


def contradicted(
    own_m: Depth, other_m: Depth, T_other_own: Matrix, camera: Camera, scene_scale: float = 1.0
) -> Mask | None:
    """Return the pixels [H, W] of a depth image, m, that show something in space which another image sees to be free;
    None without any. scene_scale: size of the scene relative to a room."""
    other = Earlier(other_m, T_other_own, CLEAR_M * scene_scale)
    found = dynamic_mask(other, None, own_m, camera, whole_objects=True, step=coarse_step(camera))
    return None if found is None else found.hidden


def mask_keyframes(keyframes: Sequence[Keyframe], config: MovingConfig, scene_scale: float = 1.0) -> None:
    """Mask what moves in the newest keyframe, and what has gone since in earlier ones, in depth of their targets."""
    newest = keyframes[-1]
    for earlier in chosen(keyframes[:-1], config.compared):
        came = newest.index - earlier.index <= config.still_frames or not config.still_frames
        _mask(earlier, newest, scene_scale)
        if came:
            _mask(newest, earlier, scene_scale)


def chosen(earlier: Sequence[Keyframe], count: int) -> list[Keyframe]:
    """Return keyframes to compare the next one with: the one before it, and ever older ones (1, 3, 6, 10, … before)."""
    back = [n * (n + 1) // 2 for n in range(1, count + 1)]
    return [earlier[-n] for n in back if n <= len(earlier)]


def _mask(own: Keyframe, other: Keyframe, scene_scale: float) -> None:
    own_m, other_m = (keyframe.target.depth_image.numpy() for keyframe in (own, other))
    T_other_own = se3.inverse(other.T_world_camera) @ own.T_world_camera
    hidden = contradicted(own_m, other_m, T_other_own, own.target.camera, scene_scale)
    if hidden is not None:
        own.target = own.target.with_depth(np.where(hidden, np.float32(0.0), own_m))


# ---- splats in free space ----


def carve(field: GaussianField, keyframes: Sequence[Keyframe], votes: int, scene_scale: float = 1.0) -> None:
    """Remove the splats whose place the newest keyframe and others see to be free, `votes` in all, unless one in
    `SUPPORT` shows a surface there. Stray ones stay."""
    means, newest = field.means.cpu().numpy(), keyframes[-1]
    sample = _sees_through(means[::SAMPLED], newest, scene_scale)
    if _are_stray(SAMPLED * int(np.count_nonzero(sample)), field):
        return
    rows = np.flatnonzero(_sees_through(means, newest, scene_scale))
    if not _are_stray(len(rows), field):
        gone = np.zeros(len(field), np.bool_)
        gone[rows] = is_free(means[rows], keyframes, votes, scene_scale)
        remove(field, gone)


def _are_stray(count: int, field: GaussianField) -> bool:
    return count < STRAY * len(field)


def remove(field: GaussianField, gone: Mask) -> None:
    """Remove splats [N] from a map, unless they are stray."""
    if gone.any() and not _are_stray(int(gone.sum()), field):
        field.keep(torch.from_numpy(~gone).to(field.params.device))


def is_free(means_m: NDArray[np.float32], keyframes: Iterable[Keyframe], votes: int, scene_scale: float = 1.0) -> Mask:
    """Return which splats with means [n, 3] m are in free space."""
    through, there = np.zeros(len(means_m), np.int64), np.zeros(len(means_m), np.int64)
    for keyframe in keyframes:
        free, surface = _seen(means_m, keyframe, CLEAR_M * scene_scale)
        through += free
        there += surface
    return np.asarray((through >= votes) & (through > SUPPORT * there))


def _sees_through(means_m: NDArray[np.float32], keyframe: Keyframe, scene_scale: float) -> Mask:
    """Return which splats with means [n, 3] m a keyframe sees through."""
    depth_m, T_camera_world = keyframe.target.depth_image.numpy(), se3.inverse(keyframe.T_world_camera)
    free = free_places(means_m.T, T_camera_world, depth_m, keyframe.target.camera, CLEAR_M * scene_scale)
    if free.any():
        depth, _, _, at = _on_keyframe(means_m[free], keyframe)
        free[free] = np.take(depth, at) > 0
    return free


def _seen(means_m: NDArray[np.float32], keyframe: Keyframe, clear_m: float) -> tuple[Mask, Mask]:
    """Return which splats with means [n, 3] m a keyframe sees through, and at which it shows a surface."""
    depth, z, inside, at = _on_keyframe(means_m, keyframe)
    limit = np.asarray(np.float32(clear_m) + np.float32(CLEAR_RELATIVE) * z)
    near, far = (np.take(plane, at) for plane in Earlier(depth, np.eye(4)).range_m)
    free = inside & (np.take(depth, at) > 0) & (z + limit < near)
    return free, inside & (z > near - limit) & (z < far + limit)


def _on_keyframe(
    means_m: NDArray[np.float32], keyframe: Keyframe
) -> tuple[Depth, NDArray[np.float32], Mask, NDArray[np.intp]]:
    """Return the depth of a keyframe [H, W], and of splats with means [n, 3] m: depth in its camera, whether they are
    in its image, and the number of their pixel."""
    camera, depth = keyframe.target.camera, np.ascontiguousarray(keyframe.target.depth_image.numpy())
    means, rows = np.ascontiguousarray(means_m.T), se3.inverse(keyframe.T_world_camera).astype(np.float32)[:3]
    # The sums are explicit: those of a library's matrix product depend on how the memory is aligned.
    x, y, z = (r[0] * means[0] + r[1] * means[1] + r[2] * means[2] + r[3] for r in rows)
    inside, row, column = on_image(x, y, z, camera)
    return depth, z, inside, row * camera.width + column
