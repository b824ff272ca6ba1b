"""Remember what recent frames saw, to notice what moves too slowly to show against the newest keyframe."""

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.slam.localisation.foreground import Depth, Earlier, Foreground, foreground
from sigmasplat.types import Matrix

EVERY = 5
"""Every fifth frame is remembered."""
KEPT = 6
AGES = (3, 6)
"""A frame is compared with the remembered ones of these places, counted from the newest one."""
COLUMNS_TESTED = 80
"""About so many columns of an image are tested."""


@dataclass(frozen=True, eq=False)
class Seen:
    """A remembered frame: its number, its depth [H, W] m with what was behind moving things, T_world_camera [4, 4]."""

    number: int
    depth_m: Depth
    T_world_camera: Matrix


@dataclass(frozen=True, eq=False)
class Memory:
    """The number of frames so far, and what some recent ones saw, the newest last."""

    frames: int = 0
    seen: tuple[Seen, ...] = ()

    def after(self, depth_m: Depth, front: Foreground | None, T_world_camera: Matrix) -> "Memory":
        """Return the memory after one more frame."""
        if self.frames % EVERY:
            return replace(self, frames=self.frames + 1)
        scene_m = depth_m if front is None else np.where(front.hidden, front.scene_m, depth_m)
        seen = (*self.seen, Seen(self.frames, scene_m, T_world_camera))[-KEPT:]
        return Memory(self.frames + 1, seen)

    def moved_by(self, T_new_old: Matrix) -> "Memory":
        """Return the memory in other coordinates [4, 4]."""
        return replace(self, seen=tuple(replace(s, T_world_camera=T_new_old @ s.T_world_camera) for s in self.seen))

    def in_front(self, depth_m: Depth, T_world_camera: Matrix, camera: Camera, most_frames: int) -> Foreground | None:
        """Find what is in places that a remembered frame, at most `most_frames` old (0 = any), saw to be free."""
        chosen = {max(len(self.seen) - age, 0) for age in AGES} if self.seen else set[int]()
        found = []
        for earlier in (self.seen[place] for place in sorted(chosen)):
            if most_frames and self.frames - earlier.number > most_frames:
                continue
            scene = Earlier(earlier.depth_m, se3.inverse(earlier.T_world_camera) @ T_world_camera)
            step = max(2, camera.width // COLUMNS_TESTED)
            found.append(foreground(scene, None, depth_m, camera, whole_objects=True, step=step))
        return reduce(together, found, None)


def together(a: Foreground | None, b: Foreground | None) -> Foreground | None:
    """Return all that is in front by one finding or the other."""
    if a is None or b is None:
        return b if a is None else a
    scene_m = np.where(a.hidden & b.hidden, np.maximum(a.scene_m, b.scene_m), np.where(b.hidden, b.scene_m, a.scene_m))
    return Foreground(a.hidden | b.hidden, np.maximum(a.depth_m, b.depth_m), scene_m)
