"""Keep what moves out of the final map, as `mapping.moving` keeps it out of each submap: keyframes are compared across
submaps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field as dataclass_field, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import MovingConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import KeyframeId, Picture, SubmapStore
from sigmasplat.final.stores import RefinedStore
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.mapping.moving import contradicted, is_free, remove
from sigmasplat.types import Matrix

STEPS_BACK = (1, 3, 6, 10)
"""A keyframe is compared with those so many before it, and with the `REVISITS` nearest of all earlier ones."""
REVISITS = 2
TURN_M = 1.0
"""Keyframes are near each other by the distance of their cameras, and by so many metres per radian of turn."""


@dataclass(frozen=True, eq=False)
class StillStore(RefinedStore):
    """A store whose keyframes have no depth where something moved.

    hidden: the pixels [H, W] of each keyframe that are masked, packed into bits, by submap and keyframe.
    """

    hidden: dict[KeyframeId, NDArray[np.uint8]] = dataclass_field(default_factory=dict)

    def picture(self, index: int, keyframe: int) -> Picture:
        picture, bits = self.store.picture(index, keyframe), self.hidden.get((index, keyframe))
        if bits is None:
            return picture
        hidden = np.unpackbits(bits, count=picture.depth_m.size).reshape(picture.depth_m.shape).astype(bool)
        return replace(picture, depth_m=np.where(hidden, np.float32(0.0), picture.depth_m))

    def hide(self, place: KeyframeId, pixels: NDArray[np.bool_]) -> None:
        """Mask more pixels [H, W] of a keyframe."""
        bits = np.packbits(pixels)
        self.hidden[place] = bits | self.hidden.get(place, bits)


def without_moving(store: SubmapStore, anchors: Sequence[Matrix], config: MovingConfig) -> StillStore:
    """Return the store with what moves masked in its keyframes; anchors: T_world_submap [4, 4] of each submap."""
    still, places = StillStore(store), [(s, k) for s in range(len(store)) for k in range(len(store.load(s).frames))]
    poses = [anchors[s] @ T for s in range(len(store)) for T in store.load(s).T_submap_camera]
    frames = [frame for s in range(len(store)) for frame in store.load(s).frames]
    camera = store.load(0).camera
    for late, others in enumerate(_compared(poses)):
        for early in others:
            close = frames[late] - frames[early] <= config.still_frames or not config.still_frames
            for own, other in ((early, late), (late, early))[: 1 + close]:
                own_m, other_m = (still.picture(*places[n]).depth_m for n in (own, other))
                pixels = contradicted(own_m, other_m, se3.inverse(poses[other]) @ poses[own], camera)
                if pixels is not None:
                    still.hide(places[own], pixels)
    return still


def _compared(poses: Sequence[Matrix]) -> Iterator[list[int]]:
    """Yield the earlier keyframes that each one is compared with."""
    positions = np.array([T[:3, 3] for T in poses])
    ahead = np.array([T[:3, 2] for T in poses])
    for late in range(len(poses)):
        others = [late - n for n in STEPS_BACK if n <= late]
        rest = max(late - STEPS_BACK[-1], 0)
        if rest:
            turn = np.arccos(np.clip(ahead[:rest] @ ahead[late], -1.0, 1.0))
            apart = np.linalg.norm(positions[:rest] - positions[late], axis=1) + TURN_M * turn
            others += np.argsort(apart, kind="stable")[:REVISITS].tolist()
        yield others


def carved(field: GaussianField, store: SubmapStore, anchors: Sequence[Matrix], config: MovingConfig) -> None:
    """Remove the splats of a map in the world from space that the keyframes of all submaps see to be free."""

    def keyframes() -> Iterator[Keyframe]:
        for s in range(len(store)):
            submap = store.load(s)
            for k, T in enumerate(submap.T_submap_camera):
                size = submap.camera.height, submap.camera.width
                yield Keyframe(k, Target.of_picture(store.picture(s, k), submap.camera, size), anchors[s] @ T)

    remove(field, is_free(field.means.numpy(), keyframes(), config.carve_votes))
