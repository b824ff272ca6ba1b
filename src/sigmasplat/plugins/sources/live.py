"""Read frames from a live camera and record each one, so that the sequence can be read again."""

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sigmasplat.config import InputConfig
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.input.prefetch import read_ahead
from sigmasplat.input.source import Source
from sigmasplat.plugins.sources.tum import TumWriter


class _NoLength(SourceError, TypeError):
    """The length is unknown. It is a TypeError too, because list() accepts a missing length only as TypeError."""


class LiveSource(Source):
    """A live camera. Frames come once, until the consumer stops, the limit is reached, or the camera fails.

    dropped: number of frames that arrived while the previous one was processed; only the newest is used;
    ending: why the camera stopped, "" if it did not; notes: what did not work, though the camera goes on.
    """

    live = True

    def __init__(self, name: str, camera: Camera, settings: InputConfig) -> None:
        super().__init__(name, camera, settings.strict)
        self._settings = settings
        self._writer: TumWriter | None = None
        self.dropped = 0
        self.ending = ""
        self.notes: list[str] = []

    def record_to(self, folder: Path) -> None:
        """Record every frame to a new TUM folder. Raises RunError if it holds a sequence or cannot be written."""
        self._writer = TumWriter(folder, self.camera)

    def __len__(self) -> int:
        """Raise SourceError: the length is unknown."""
        raise _NoLength(self._once())

    def frame(self, i: int) -> Frame:
        """Raise SourceError: frames come only once, in order."""
        raise SourceError(self._once())

    def truth(self) -> Trajectory | None:
        """Return None: a live camera has no ground truth."""
        return None

    def frames_from(self, first: int) -> Iterator[Frame]:
        """Yield frames as they arrive, at most one ahead. Raises SourceError if the camera delivers no frame."""
        if first:
            raise SourceError(self._once())
        return read_ahead(self._recorded(), 1)

    @abstractmethod
    def captured(self) -> Iterator[Frame]:
        """Yield the newest frame repeatedly, numbered from 0; stop the camera at the end."""

    def _recorded(self) -> Iterator[Frame]:
        for index, frame in enumerate(self._wanted()):
            numbered = replace(frame, index=index)
            if self._writer:
                self._writer.add(numbered)
            yield numbered
            if index + 1 == self._settings.limit:
                return

    def _wanted(self) -> Iterator[Frame]:
        """Yield every stride-th frame between start_s and end_s, seconds after the first frame."""
        begin_s: float | None = None
        for count, frame in enumerate(self.captured()):
            begin_s = frame.timestamp_s if begin_s is None else begin_s
            elapsed_s = frame.timestamp_s - begin_s
            if self._settings.end_s and elapsed_s >= self._settings.end_s:
                return
            if elapsed_s >= self._settings.start_s and count % self._settings.stride == 0:
                yield frame

    def _once(self) -> str:
        return f"{self.name}: a live camera delivers each frame once; run it, then read the folder with its recording"


def recording_settings(settings: InputConfig) -> InputConfig:
    """Return the settings for reading the recording of a run, whose frames are already selected and rectified."""
    return InputConfig(
        strict=settings.strict, width=settings.width, crop_px=settings.crop_px,
        min_depth_m=settings.min_depth_m, max_depth_m=settings.max_depth_m,
    )  # fmt: skip
