"""Write films: .webm and .mp4 as VP9, which browsers play and which needs no code under the GPL; .gif and .webp.

VP9 comes with opencv-python-headless (Apache-2.0), whose wheels hold libvpx and neither x264 nor x265. It is loaded
when used.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.env import install_extra
from sigmasplat.errors import BackendError, RunError
from sigmasplat.io.atomic import replacing

Rgb = NDArray[np.uint8]

CODECS = {".webm": "VP90", ".mp4": "vp09"}
PICTURES = {".gif": "GIF", ".webp": "WEBP"}
ENDINGS = (*CODECS, *PICTURES)
NO_IMAGES = "a film needs at least one image, found none"


def write_video(path: Path, images: Iterable[Rgb], fps: float) -> None:
    """Write images uint8 RGB [H, W, 3], all of one size, as a film, as its name's ending says, in one step.

    Raises RunError on another ending, an unwritable place or where the codec is not there; BackendError without OpenCV.
    """
    check_name(path)
    kind = path.suffix.lower()
    with replacing(path) as temporary:
        scratch = temporary.with_suffix(kind)  # OpenCV goes by the ending
        try:
            if kind in CODECS:
                _write_vp9(scratch, images, fps, CODECS[kind])
            else:
                _write_pictures(scratch, iter(images), fps, PICTURES[kind])
            os.replace(scratch, temporary)
        finally:
            scratch.unlink(missing_ok=True)


def check_name(path: Path) -> None:
    """Raise RunError unless a film can be written under this name, BackendError where OpenCV is missing for it."""
    if path.suffix.lower() not in ENDINGS:
        raise RunError(f"cannot write a film as {path.name}; give a name that ends in {', '.join(ENDINGS)}")
    if path.suffix.lower() in CODECS:
        _opencv()


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as problem:
        raise BackendError(
            f"films as .webm and .mp4 need OpenCV: {install_extra('video')}; or write .gif or .webp"
        ) from problem
    return cv2


def _write_vp9(path: Path, images: Iterable[Rgb], fps: float, codec: str) -> None:
    """Encode with VP9; odd sizes, which it cannot halve, lose their last row or column."""
    cv2, writer, size = _opencv(), None, (0, 0)
    try:
        for image in images:
            if writer is None:
                size = (image.shape[1] // 2 * 2, image.shape[0] // 2 * 2)
                with _quiet():
                    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), fps, size)
                if not writer.isOpened():
                    raise RunError(
                        f"cannot write {path.name} with this OpenCV; write .gif or .webp, or a writable place"
                    )
            writer.write(np.ascontiguousarray(image[: size[1], : size[0], ::-1]))
    finally:
        if writer is not None:
            writer.release()
    if writer is None:
        raise RunError(NO_IMAGES)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the process's standard error silent: OpenCV warns there of a tag in .webm that it mends itself."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _write_pictures(path: Path, images: Iterator[Rgb], fps: float, kind: str) -> None:
    """Write an animation that repeats."""
    first = next(images, None)
    if first is None:
        raise RunError(NO_IMAGES)
    rest = (Image.fromarray(image) for image in images)
    duration_ms = round(1000.0 / fps)
    options = {"quality": 80} if kind == "WEBP" else {}
    Image.fromarray(first).save(
        path, kind, save_all=True, append_images=rest, duration=duration_ms, loop=0, **options
    )  # fmt: skip
