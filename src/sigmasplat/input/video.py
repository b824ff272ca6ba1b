"""Read the frames of a video file in exact order through OpenCV."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.errors import SourceError
from sigmasplat.files.optional import import_optional
from sigmasplat.input.folders import FRAMES_PER_SECOND


class Video:
    """An open video. Reading forwards is fast. Reading backwards restarts at the first frame, because seeking by frame
    number is not exact in videos with a variable frame rate, as from phones. Safe to use from several threads.

    size: (width, height); count: number of frames that the file states; frames_per_second: as stated, else 30.
    """

    def __init__(self, path: Path) -> None:
        """Open the file. Raises SourceError if OpenCV is missing or cannot read it."""
        self.path, self._lock = path, threading.Lock()
        self._cv2 = import_optional("cv2", "iphone", f"{path}: a video")
        self._open()
        width, height = (
            int(self._capture.get(p)) for p in (self._cv2.CAP_PROP_FRAME_WIDTH, self._cv2.CAP_PROP_FRAME_HEIGHT)
        )
        self.size = width, height
        self.count = int(self._capture.get(self._cv2.CAP_PROP_FRAME_COUNT))
        stated = float(self._capture.get(self._cv2.CAP_PROP_FPS))
        self.frames_per_second = stated if 0.1 < stated < 1000.0 else FRAMES_PER_SECOND

    def frame(self, i: int) -> NDArray[np.uint8]:
        """Read frame i as 8-bit RGB [H, W, 3]. Raises SourceError if the video ends before it or is damaged."""
        with self._lock:
            if i < self._next:
                self._open()
            while self._next <= i:
                if not self._capture.grab():
                    raise SourceError(
                        f"{self.path}: ends after {self._next} frames, but frame {i} was requested; copy it again"
                    )
                self._next += 1
            read, bgr = self._capture.retrieve()
        if not read:
            raise SourceError(f"{self.path}: frame {i} cannot be decoded; copy the video again")
        rgb: NDArray[np.uint8] = np.ascontiguousarray(bgr[..., ::-1])
        return rgb

    def _open(self) -> None:
        self._next = 0
        self._capture: Any = self._cv2.VideoCapture(str(self.path))
        if not self._capture.isOpened():
            raise SourceError(f"{self.path}: unreadable video; copy it again (OpenCV needs FFmpeg to read HEVC)")
        self._capture.set(
            self._cv2.CAP_PROP_ORIENTATION_AUTO, 0
        )  # keep the recorded orientation: depth is not rotated either
