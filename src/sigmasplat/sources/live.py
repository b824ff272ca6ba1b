"""Take frames from a camera as it delivers them, and record each one, so that it can be read again afterwards."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.model.camera import Camera
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.base import Source
from sigmasplat.sources.files.prefetch import read_ahead
from sigmasplat.sources.tum import TumWriter


class _NoLength(SourceError, TypeError):
    """Say that there is no length: list() asks for one, and goes on without where a TypeError says no."""


class LiveSource(Source):
    """A camera: its frames come once, and end when whoever iterates stops, the limit is reached, or the camera goes.

    dropped: frames that the camera delivered while the last one was still being worked on; the newest wins;
    ending: why the camera ended the sequence by itself, "" as long as it did not.
    """

    live = True

    def __init__(self, name: str, camera: Camera, settings: InputConfig) -> None:
        super().__init__(name, camera, settings.strict)
        self._settings = settings
        self._writer: TumWriter | None = None
        self.dropped = 0
        self.ending = ""

    def record_to(self, folder: Path) -> None:
        """Write every frame taken to a new TUM folder. Raises RunError if it holds a sequence or cannot be written."""
        self._writer = TumWriter(folder, self.camera)

    def __len__(self) -> int:
        """Raises SourceError: nobody knows."""
        raise _NoLength(self._once())

    def frame(self, i: int) -> Frame:
        """Raises SourceError: frames come once."""
        raise SourceError(self._once())

    def truth(self) -> Trajectory | None:
        """Return None: a camera does not know where it is."""
        return None

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield frames as they come, at most one ahead. Raises SourceError if the camera delivers none."""
        if first:
            raise SourceError(self._once())
        return read_ahead(self._recorded(), 1)

    @abstractmethod
    def captured(self) -> Iterator[Frame]:
        """Yield the camera's newest frame again and again, with its index among them; stop the camera in the end."""

    def _recorded(self) -> Iterator[Frame]:
        for index, frame in enumerate(self._wanted()):
            numbered = replace(frame, index=index)
            if self._writer:
                self._writer.add(numbered)
            yield numbered
            if index + 1 == self._settings.limit:
                return

    def _wanted(self) -> Iterator[Frame]:
        """Keep every stride-th frame of the span of time that the settings ask for, counted from the first."""
        begin_s: float | None = None
        for count, frame in enumerate(self.captured()):
            begin_s = frame.timestamp_s if begin_s is None else begin_s
            elapsed_s = frame.timestamp_s - begin_s
            if self._settings.end_s and elapsed_s >= self._settings.end_s:
                return
            if elapsed_s >= self._settings.start_s and count % self._settings.stride == 0:
                yield frame

    def _once(self) -> str:
        return f"{self.name}: a live camera gives its frames once; run it, then read the folder it was recorded to"


def recording_settings(settings: InputConfig) -> InputConfig:
    """Return the settings to read a recording with: what was done to the frames before they were written is done."""
    return InputConfig(
        strict=settings.strict, width=settings.width, crop_px=settings.crop_px,
        min_depth_m=settings.min_depth_m, max_depth_m=settings.max_depth_m,
    )  # fmt: skip
