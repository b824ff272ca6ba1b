"""Submaps, and the stores that keep finished ones."""

from collections.abc import Sequence
from dataclasses import dataclass, field as dataclass_field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera, unexposed
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Detail, Photo
from sigmasplat.types import Matrix

KeyframeId = tuple[int, int]
"""Number of the submap, and number of the keyframe in it; both count from 0."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The images of a keyframe: color [H, W, 3] uint8 RGB, depth_m [H, W] float32 metres, 0 = no reading; detail: the
    gray image in which features are found, and photo: the colour at the camera's own size, if they were kept."""

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    detail: Detail | None = None
    photo: Photo | None = None

    @property
    def unit_color(self) -> NDArray[np.float32]:
        """Return the colour in [0, 1]."""
        return self.color.astype(np.float32) / np.float32(255.0)

    def without_exposure(self, exposure: Matrix) -> "Picture":
        """Return the same images with the colour in the exposure of the map (`data.camera`), not photo and detail."""
        color = np.rint(unexposed(self.unit_color, exposure) * 255.0).astype(np.uint8)
        return replace(self, color=color)


@dataclass(frozen=True, eq=False)
class Submap:
    """A finished part of the map in its own frame, which is the camera of its first keyframe.

    field: its splats; frames [K]: the frame numbers of its keyframes, counted from the first frame of the run (those of
    an earlier session are negative, −1 is its last frame: `run --onto`); T_submap_camera [K, 4, 4]: their poses;
    camera: shared by all keyframes. The `SubmapStore` keeps the keyframes' images, the `Atlas` the submap's pose in the
    world. probe_frames [P], T_submap_probe [P, 4, 4]: the same of its probe views, to which nothing is fitted.
    """

    index: int
    field: GaussianField
    frames: tuple[int, ...]
    T_submap_camera: Matrix
    camera: Camera
    probe_frames: tuple[int, ...] = ()
    T_submap_probe: Matrix = dataclass_field(default_factory=lambda: np.empty((0, 4, 4)))


class SubmapStore(Protocol):
    """Finished submaps, numbered from 0 in the order of saving, as they are read."""

    def __len__(self) -> int: ...

    def load(self, index: int) -> Submap:
        """Return a submap; the caller may change it."""

    def picture(self, index: int, keyframe: int) -> Picture:
        """Return the images of one keyframe of a submap."""

    def probe(self, index: int, probe: int) -> Picture:
        """Return the images of one probe view of a submap."""


class GrowingStore(SubmapStore, Protocol):
    """Keeps finished submaps."""

    def save(self, submap: Submap, pictures: list[Picture], probes: Sequence[Picture] = ()) -> None:
        """Save a submap and the images of its keyframes and probe views. A finished submap never changes."""


@runtime_checkable
class OnDisk(Protocol):
    """A store in a folder, which may not exist before the first submap."""

    folder: Path

    def settle(self) -> None:
        """Wait until what was saved is on the disk."""


@dataclass(eq=False)
class MemoryStore:
    """Keeps submaps in memory: for short runs, and when no files may be written."""

    submaps: list[Submap] = dataclass_field(default_factory=list)
    pictures: list[list[Picture]] = dataclass_field(default_factory=list)
    probes: list[list[Picture]] = dataclass_field(default_factory=list)

    def __len__(self) -> int:
        return len(self.submaps)

    def save(self, submap: Submap, pictures: list[Picture], probes: Sequence[Picture] = ()) -> None:
        """Save a submap, which must be the next one."""
        complete = len(submap.frames) == len(pictures) and len(submap.probe_frames) == len(probes)
        assert submap.index == len(self) and complete, "submaps are saved in their order, with all images"
        self.submaps.append(submap)
        self.pictures.append(pictures)
        self.probes.append(list(probes))

    def load(self, index: int) -> Submap:
        return self.submaps[index]

    def picture(self, index: int, keyframe: int) -> Picture:
        return self.pictures[index][keyframe]

    def probe(self, index: int, probe: int) -> Picture:
        return self.probes[index][probe]
