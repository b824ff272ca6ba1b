"""Define the interface of an input sequence, the same for every format; a background thread reads ahead."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.mesh import Mesh
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.files.reading import guarded
from sigmasplat.input.calibration import ALONG_RAY, ASSUMED, MEASURED, Origin
from sigmasplat.native.threads import yield_to_others

Item = TypeVar("Item")
END: Any = object()


def read_ahead(items: Iterable[Item], length: int = 4) -> Iterator[Item]:
    """Yield `items` in order while a thread computes up to `length` of them in advance.

    Decoding an image takes 10 to 50 ms and releases the interpreter lock, so it runs beside tracking, and yields to it.
    An exception of the producer is raised here in place of the item. The thread ends after the last item,
    or as soon as the consumer closes or deletes this generator.
    """
    iterator, pool = iter(items), ThreadPoolExecutor(1, "read-ahead", yield_to_others)
    try:
        waiting = deque(pool.submit(next, iterator, END) for _ in range(length))
        while (item := waiting.popleft().result()) is not END:
            waiting.append(pool.submit(next, iterator, END))
            yield item
    finally:
        pool.shutdown(cancel_futures=True)


FACTS = (
    "depth_units_per_metre", "depth_registered", "registrable", "computed_depth", "predicted_depth",
    "scene_scale", "depth_noise_per_m", "sensor", "origins", "depth_doubts", "path_by",
)  # fmt: skip
ANSWERS = ("device_path", "test_views", "true_surface", "true_surface_file")
"""What a source that wraps another one has in common with it, and the methods that it passes on."""
ALL_FRAMES = InputConfig()
CORRECTED = ("orientation", "gray", "farthest depth")
"""Origins of how images are changed when they are read."""


class Source(ABC):
    """An RGB-D sequence: frames in order of time, one camera, and the ground-truth path if it is known.

    name: for titles; camera: the pinhole camera of every frame; skipped: files left out, each with the reason;
    strict: whether an unreadable image raises an error instead of being skipped;
    depth_units_per_metre: divisor of whole-number depth, None if depth is stored in metres;
    depth_registered: whether the source itself moved depth to the colour camera; registrable: whether it could do so,
    because the depth camera is known;
    computed_depth: whether the source computes depth itself, from a stereo pair; predicted_depth: whether a network
    predicted depth, so that its scale is arbitrary;
    scene_scale: size of the scene relative to a room, above 1 outdoors; depth_noise_per_m: standard deviation
    of depth, times z²; None if it is unknown (`config.scale.for_scene` uses both);
    sensor: the depth sensor (`config.input`), None if it is unknown;
    path_by: whose estimate the path of `truth` is, in words; empty if it is a ground truth;
    origins: where the values that decide the result come from, by name (`assumptions`);
    depth_doubts: what the values of depth images seem to mean, if that is not depth in metres;
    live: whether frames come from a live camera: each only once, and their number is unknown (LiveSource);
    arrived_s: when the last frame arrived, by `time.perf_counter`, if frames do not wait for the consumer (Arrivals);
    dropped: number of frames that were dropped because the consumer was late.
    """

    name: str
    camera: Camera
    strict: bool = False
    depth_units_per_metre: float | None = None
    depth_registered: bool = False
    registrable: bool = False
    computed_depth: bool = False
    predicted_depth: bool = False
    scene_scale: float = 1.0
    depth_noise_per_m: float | None = None
    sensor: str | None = None
    path_by: str = ""
    live: bool = False
    arrived_s: float | None = None
    dropped: int = 0

    def __init__(self, name: str, camera: Camera, strict: bool = False) -> None:
        self.name = name
        self.camera = camera
        self.strict = strict
        self.skipped: list[str] = []
        self.origins: dict[str, Origin] = {}
        self.depth_doubts: list[str] = []

    @property
    def assumptions(self) -> list[str]:
        """Return what is assumed because the recording does not say it, and the option that changes it."""
        return [f"{name}: {o.value} ({o.option})" for name, o in self.origins.items() if o.origin == ASSUMED]

    @property
    def corrections(self) -> list[str]:
        """Return how images are read in another way than they are stored, because of what they show or say."""
        changed = [(n, o.value) for n, o in self.origins.items() if n in CORRECTED or o.value == ALONG_RAY]
        measured = [(n, o.origin) for n, o in self.origins.items() if n == "camera" and o.origin.startswith(MEASURED)]
        return [f"{name}: {words}" for name, words in changed + measured]

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of frames, including unreadable ones."""

    @abstractmethod
    def frame(self, i: int) -> Frame:
        """Read frame i, 0 ≤ i < len. Raises SourceError if its files cannot be read, IndexError if i is too large."""

    def timestamp_s(self, i: int) -> float:
        """Return the time of frame i; formats may override this to avoid reading it. Raises as `frame`."""
        return self.frame(i).timestamp_s

    def depth_of(self, i: int) -> NDArray[np.float32]:
        """Read the depth of frame i, m [H, W]; formats override this to avoid reading colour. Raises as `frame`."""
        return self.frame(i).depth_m

    def exact_depth_of(self, i: int) -> NDArray[np.float32] | None:
        """Return the exact depth of frame i, m [H, W], 0 where there is no surface; None if it is unknown."""
        return None

    @abstractmethod
    def truth(self) -> Trajectory | None:
        """Return the ground-truth path as recorded, with its own timestamps and world frame; None if it is unknown."""

    def described_truth(self) -> str | None:
        """Describe the size of the recorded path in words, not the path itself; None if it is unknown."""
        path = self.truth()
        if path is None:
            return None
        length_m = float(np.linalg.norm(np.diff(path.T_world_camera[:, :3, 3], axis=0), axis=1).sum())
        what = f"poses of {self.path_by}" if self.path_by else "true poses"
        use = "; not a ground truth; to use them: --poses recorded" * bool(self.path_by)
        return f"{len(path)} {what}, {length_m:.1f} m long{use}"

    def image_name(self, i: int) -> str:
        """Return the name of the file of colour image i; "" if images are not files."""
        return ""

    def device_path(self) -> Trajectory | None:
        """Return the path of the camera that the recording device estimated itself, such as ARKit's, with timestamps in
        the clock of the frames; None without one."""
        return None

    def test_views(self) -> "Source | None":
        """Return test views away from the camera path, with poses in `truth`'s world frame; None without them."""
        return None

    def true_surface(self) -> Mesh | None:
        """Return the true surface in `truth`'s world frame, with hidden parts, faces of a few cm; None if unknown."""
        return None

    def true_surface_file(self) -> Path | None:
        """Return the PLY file of the true surface, in `truth`'s world frame, if the data set has one beside the
        sequence; else None."""
        return None

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames in order; a background thread decodes a few frames ahead.

        An unreadable frame is skipped and listed in `skipped`, or raises SourceError if `strict`. Raises SourceError
        if no frame can be read.
        """
        return self.frames_from(0)

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield the frames from index `first`, in the same way as iteration."""
        return read_ahead(self._readable(first))

    def _readable(self, first: int) -> Iterator[Frame]:
        found = first > 0  # an earlier pass has read some
        for i in range(first, len(self)):
            try:
                with guarded(f"{self.name}, frame {i}", "copy its files again", SourceError):
                    frame = self.frame(i)
            except SourceError as error:
                if self.strict:
                    raise
                if str(error) not in self.skipped:  # a second pass finds the same damage
                    self.skipped.append(str(error))
                continue
            found = True
            yield frame
        if not found:
            raise SourceError(f"{self.name}: none of {len(self)} frames can be read (first: {self.skipped[:1]})")

    def _checked_index(self, i: int) -> int:
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name}: frame {i} requested, there are {len(self)}")
        return i


class Wrapped(Source):
    """Another source with the same facts and the same ground truth, which has its own timestamps."""

    def __init__(self, whole: Source) -> None:
        super().__init__(whole.name, whole.camera, whole.strict)
        self._whole, self.skipped = whole, whole.skipped
        for fact in FACTS + ANSWERS:
            setattr(self, fact, getattr(whole, fact))

    def truth(self) -> Trajectory | None:
        return self._whole.truth()


class Subset(Wrapped):
    """Part of another source: a time span, every `stride`-th frame, at most `limit`; frames are numbered from 0."""

    def __init__(self, whole: Source, settings: InputConfig = ALL_FRAMES, refuse_live: str = "") -> None:
        """Select the frames. Raises SourceError if no frame is left, or `refuse_live` if it is a live camera."""
        if refuse_live and whole.live:
            raise SourceError(refuse_live)
        super().__init__(whole)
        self._indices: Sequence[int] = _within(whole, settings)[:: settings.stride][: settings.limit or None]
        if not len(self._indices):
            raise SourceError(
                f"{whole.name}: no frame between input.start_s={settings.start_s:g} and end_s={settings.end_s:g}; "
                f"its {len(whole)} frames take {whole.timestamp_s(len(whole) - 1) - whole.timestamp_s(0):.1f} s"
            )

    def __len__(self) -> int:
        return len(self._indices)

    def _at(self, i: int) -> int:
        return self._indices[self._checked_index(i)]

    def frame(self, i: int) -> Frame:
        return replace(self._whole.frame(self._at(i)), index=i)

    def timestamp_s(self, i: int) -> float:
        return self._whole.timestamp_s(self._at(i))

    def depth_of(self, i: int) -> NDArray[np.float32]:
        return self._whole.depth_of(self._at(i))

    def exact_depth_of(self, i: int) -> NDArray[np.float32] | None:
        return self._whole.exact_depth_of(self._at(i))

    def image_name(self, i: int) -> str:
        return self._whole.image_name(self._at(i))


def _within(whole: Source, settings: InputConfig) -> range:
    """Return the frames between start_s and end_s, seconds after the first frame."""
    if not settings.start_s and not settings.end_s:
        return range(len(whole))
    begin_s = whole.timestamp_s(0)
    elapsed_s = [whole.timestamp_s(i) - begin_s for i in range(len(whole))]
    first = sum(t < settings.start_s for t in elapsed_s)
    return range(first, sum(t < settings.end_s for t in elapsed_s) if settings.end_s else len(whole))
