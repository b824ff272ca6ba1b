"""Say what every input sequence offers, whatever its format."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.model.camera import Camera
from sigmasplat.model.frame import Frame
from sigmasplat.model.mesh import Mesh
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.files.prefetch import read_ahead


class Source(ABC):
    """An RGB-D sequence: frames in order of time, one camera, perhaps a true path.

    name: for titles; camera: the pinhole of every frame; skipped: files left out, each with the reason;
    strict: whether an unreadable image ends the sequence instead of being passed over;
    depth_units_per_metre: what whole-number depth was divided by, None where depth is metres already;
    depth_registered: whether depth was moved into the colour camera here, instead of coming so; registrable: whether it
    could be, its camera being known;
    live: whether frames come from a camera as they are taken, once, and nobody knows how many (LiveSource).
    """

    name: str
    camera: Camera
    strict: bool = False
    depth_units_per_metre: float | None = None
    depth_registered: bool = False
    registrable: bool = False
    live: bool = False

    def __init__(self, name: str, camera: Camera, strict: bool = False) -> None:
        self.name = name
        self.camera = camera
        self.strict = strict
        self.skipped: list[str] = []

    @abstractmethod
    def __len__(self) -> int:
        """Count the frames, unreadable ones included."""

    @abstractmethod
    def frame(self, i: int) -> Frame:
        """Read frame i, 0 ≤ i < len. Raises SourceError if its files cannot be read, IndexError past the end."""

    def timestamp_s(self, i: int) -> float:
        """Return the time of frame i; formats that know it without reading the frame say so here. Raises as `frame`."""
        return self.frame(i).timestamp_s

    def depth_of(self, i: int) -> NDArray[np.float32]:
        """Read the depth of frame i, m [H, W]; formats that need no colour for it do without. Raises as `frame`."""
        return self.frame(i).depth_m

    @abstractmethod
    def truth(self) -> Trajectory | None:
        """Return the true path as recorded, on its own timestamps and in its own world frame; None if there is none."""

    def described_truth(self) -> str | None:
        """Say in words how much true path there is, without giving it away; None if there is none."""
        path = self.truth()
        if path is None:
            return None
        length_m = float(np.linalg.norm(np.diff(path.T_world_camera[:, :3, 3], axis=0), axis=1).sum())
        return f"{len(path)} true poses, {length_m:.1f} m long"

    def test_views(self) -> "Source | None":
        """Return views kept apart for scoring, off the path; their truth is in `truth`'s world. None if none are."""
        return None

    def true_surface(self) -> Mesh | None:
        """Return the true surface in `truth`'s world frame, hidden parts too, faces of a few cm; None if not known."""
        return None

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order, decoded a few ahead in a background thread.

        An unreadable frame is noted in `skipped` and passed over, or raised where `strict`. Raises SourceError if not
        one frame can be read.
        """
        return self.frames_from(0)

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield the frames from index `first` on, as iteration does."""
        return read_ahead(self._readable(first))

    def _readable(self, first: int) -> Iterator[Frame]:
        found = first > 0  # then there were some before
        for i in range(first, len(self)):
            try:
                frame = self.frame(i)
            except SourceError as error:
                self._skip(error)
                continue
            found = True
            yield frame
        if not found:
            raise SourceError(f"{self.name}: none of {len(self)} frames can be read (first: {self.skipped[:1]})")

    def _skip(self, error: SourceError) -> None:
        if self.strict:
            raise error
        if str(error) not in self.skipped:  # a second pass over the frames meets the same damage
            self.skipped.append(str(error))

    def _checked_index(self, i: int) -> int:
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name}: frame {i} asked for, there are {len(self)}")
        return i


class Subset(Source):
    """Frames of another source: of a span of time, every `stride`-th, at most `limit`; indices count those kept."""

    def __init__(self, whole: Source, settings: InputConfig) -> None:
        """Raises SourceError if no frame is left."""
        super().__init__(whole.name, whole.camera, whole.strict)
        self.skipped = whole.skipped
        self.depth_units_per_metre = whole.depth_units_per_metre
        self.depth_registered, self.registrable = whole.depth_registered, whole.registrable
        self._whole = whole
        self._indices = _within(whole, settings)[:: settings.stride][: settings.limit or None]
        if not len(self._indices):
            raise SourceError(
                f"{whole.name}: no frame between input.start_s={settings.start_s:g} and end_s={settings.end_s:g}; "
                f"its {len(whole)} frames take {whole.timestamp_s(len(whole) - 1) - whole.timestamp_s(0):.1f} s"
            )

    def __len__(self) -> int:
        return len(self._indices)

    def frame(self, i: int) -> Frame:
        """Read the i-th frame kept."""
        return replace(self._whole.frame(self._indices[self._checked_index(i)]), index=i)

    def timestamp_s(self, i: int) -> float:
        """Return the time of the i-th frame kept."""
        return self._whole.timestamp_s(self._indices[self._checked_index(i)])

    def depth_of(self, i: int) -> NDArray[np.float32]:
        """Read the depth of the i-th frame kept."""
        return self._whole.depth_of(self._indices[self._checked_index(i)])

    def truth(self) -> Trajectory | None:
        """Return the true path of the whole source: it is kept by time, not by frame."""
        return self._whole.truth()

    def test_views(self) -> Source | None:
        """Return the views kept apart of the whole source."""
        return self._whole.test_views()

    def true_surface(self) -> Mesh | None:
        """Return the true surface of the whole source."""
        return self._whole.true_surface()


def _within(whole: Source, settings: InputConfig) -> range:
    """Return the frames of the span of time that the settings ask for, counted from the first frame's time."""
    if not settings.start_s and not settings.end_s:
        return range(len(whole))
    begin_s = whole.timestamp_s(0)
    elapsed_s = [whole.timestamp_s(i) - begin_s for i in range(len(whole))]
    first = sum(t < settings.start_s for t in elapsed_s)
    return range(first, sum(t < settings.end_s for t in elapsed_s) if settings.end_s else len(whole))
