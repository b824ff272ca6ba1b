"""Say what every input sequence offers, whatever its format."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace

from sigmasplat.errors import SourceError
from sigmasplat.model.camera import Camera
from sigmasplat.model.frame import Frame
from sigmasplat.model.mesh import Mesh
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.read_ahead import read_ahead


class Source(ABC):
    """An RGB-D sequence: frames in order of time, one camera, perhaps a true path.

    name: for titles; camera: the pinhole of every frame; skipped: files left out, each with the reason;
    strict: whether an unreadable image ends the sequence instead of being passed over;
    depth_units_per_metre: what whole-number depth was divided by, None where depth is metres already.
    """

    name: str
    camera: Camera
    strict: bool = False
    depth_units_per_metre: float | None = None

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

    @abstractmethod
    def truth(self) -> Trajectory | None:
        """Return the true path as recorded, on its own timestamps and in its own world frame; None if there is none."""

    def true_surface(self) -> Mesh | None:
        """Return the true surface in `truth`'s world frame, hidden parts too, faces of a few cm; None if not known."""
        return None

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order, decoded a few ahead in a background thread.

        An unreadable frame is noted in `skipped` and passed over, or raised where `strict`. Raises SourceError if not
        one frame can be read.
        """
        return read_ahead(self._readable())

    def _readable(self) -> Iterator[Frame]:
        found = False
        for i in range(len(self)):
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
    """Every `stride`-th frame of another source, at most `limit` of them; indices count the frames kept."""

    def __init__(self, whole: Source, stride: int, limit: int | None) -> None:
        if stride < 1 or (limit is not None and limit < 1):
            raise SourceError(f"stride and limit must be at least 1, found stride={stride}, limit={limit}")
        super().__init__(whole.name, whole.camera, whole.strict)
        self.skipped = whole.skipped
        self.depth_units_per_metre = whole.depth_units_per_metre
        self._whole = whole
        self._indices = range(0, len(whole), stride)[:limit]

    def __len__(self) -> int:
        return len(self._indices)

    def frame(self, i: int) -> Frame:
        """Read the i-th frame kept."""
        return replace(self._whole.frame(self._indices[self._checked_index(i)]), index=i)

    def truth(self) -> Trajectory | None:
        """Return the true path of the whole source: it is kept by time, not by frame."""
        return self._whole.truth()

    def true_surface(self) -> Mesh | None:
        """Return the true surface of the whole source."""
        return self._whole.true_surface()
