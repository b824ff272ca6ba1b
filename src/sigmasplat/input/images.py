"""Find the images of a recording, pair colour with depth, and read them; every problem becomes a SourceError that names
the file."""

import re
import threading
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from sigmasplat.data.frame_arrays import depth_from_integers
from sigmasplat.env import import_optional
from sigmasplat.errors import SourceError
from sigmasplat.files.pictures import open_image, read_exr, read_npy, read_npz
from sigmasplat.files.reading import DAMAGED
from sigmasplat.input.calibration import ASSUMED, Origin

TURNS = {2: "mirrored left to right", 3: "180°", 4: "mirrored top to bottom", 5: "mirrored, 90° anticlockwise",
         6: "90° clockwise", 7: "mirrored, 90° clockwise", 8: "90° anticlockwise"}  # fmt: skip
"""How viewers turn an image by its EXIF tag of orientation."""


def read_color(path: Path, data: bytes | None = None) -> NDArray[Any]:
    """Read an image file, or `data` of one, as 8-bit RGB [H, W, 3], turned by its EXIF tag. Gray of more than 8 bits
    is returned as stored [H, W]. Raises SourceError naming a missing, truncated or damaged file."""
    if data is None:
        _refuse_missing(path)
    with open_image(path, data) as opened:
        image = _turned(opened)
        return np.asarray(image if image.mode == "RGB" or image.mode[0] in "IF" else image.convert("RGB"))


def read_values(path: Path, data: bytes | None = None, turned: bool = False) -> NDArray[Any]:
    """Decode an image file, or `data` of one, without converting its values; `turned`: by its EXIF tag. Raises
    SourceError if it is damaged."""
    with open_image(path, data) as image:
        tile: Any = image.tile and image.tile[0]
        stretched = image.mode == "I" and tile[0].startswith("ppm")  # by Pillow: the largest of the file to 65535
        values = np.asarray(_turned(image) if turned else image)
    return np.rint(values * (tile[3][-1] / 65535)).astype(np.uint16) if stretched else values


def image_size(path: Path, data: bytes | None = None) -> tuple[int, int]:
    """Return (width, height) of an image file, or of `data`, turned by its EXIF tag. Raises SourceError for others."""
    if data is None:
        _refuse_missing(path)
    with open_image(path, data) as image:
        return (image if _orientation(image) < 5 else _turned(image)).size


def color_origins(path: Path) -> dict[str, Origin]:
    """Return how an image file is turned by its EXIF tag, and that its transparency is ignored; empty if neither."""
    found: dict[str, Origin] = {}
    with suppress(SourceError), open_image(path) as image:
        if turn := TURNS.get(_orientation(image)):
            found["orientation"] = Origin(f"turned by the EXIF tag of the images ({turn})", f"read from {path}")
        if image.has_transparency_data and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            found["transparency"] = Origin("ignored, such pixels are used as the others", ASSUMED, "--masks FOLDER")
    return found


def _orientation(image: Image.Image) -> int:
    with suppress(*DAMAGED):  # a damaged tag turns nothing; the method of PNG would decode the image
        return int(Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1))
    return 1


def _turned(image: Image.Image) -> Image.Image:
    image.load()  # this turns TIFF, and deletes its tag
    return ImageOps.exif_transpose(image) if _orientation(image) in TURNS else image


def depth_values(path: Path) -> NDArray[Any]:
    """Read the stored values of a depth image, [H, W] if it is one. Raises SourceError naming an unreadable file."""
    _refuse_missing(path)
    return {".npy": read_npy, ".npz": read_npz, ".exr": read_exr}.get(path.suffix.lower(), read_values)(path)


def read_depth(path: Path, units_per_metre: float, confidence: Path | None = None) -> NDArray[np.float32]:
    """Read depth along the optical axis as float32 metres [H, W], 0 = no reading.

    Whole numbers (16-bit PNG, integer .npy) are divided by `units_per_metre`; floats (.tiff, .npy, .exr) are in metres.
    confidence: an image whose zeros mark readings to ignore; it may be missing. Raises SourceError if a file is
    unreadable, not a single-channel depth image, negative, or holds NaN or inf.
    """
    depth_m = depth_to_metres(path, depth_values(path), units_per_metre)
    if confidence is None or not confidence.is_file():
        return depth_m
    sure = read_values(confidence)
    if sure.shape != depth_m.shape:
        raise SourceError(f"{confidence}: {sure.shape} values for depth of {depth_m.shape}; copy it again")
    return np.where(sure > 0, depth_m, np.float32(0.0))


def depth_to_metres(path: Path, raw: NDArray[Any], units_per_metre: float) -> NDArray[np.float32]:
    """Convert a stored depth image to float32 metres, as `read_depth` does; `path` names it. Raises SourceError."""
    if raw.ndim == 3 and 1 in (raw.shape[0], raw.shape[2]):
        raw = raw.reshape(raw.shape[:2] if raw.shape[2] == 1 else raw.shape[1:])
    elif raw.dtype == np.uint8 and raw.shape[2:] == (4,) and (raw[..., 3] < 128).all():  # the bytes of floats, as BGRA
        raw = np.ascontiguousarray(raw[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
    if raw.ndim != 2 or raw.dtype == np.uint8 or raw.dtype.kind not in "iuf":
        raise SourceError(
            f"{path}: not a depth image (found {raw.dtype} {raw.shape}); JPEG and 8 bits hold no metric depth: "
            "export 16-bit PNG or float metres"
        )
    depth_m = raw.astype(np.float32) if raw.dtype.kind == "f" else depth_from_integers(raw, units_per_metre)
    if not (read := np.isfinite(depth_m)).all():
        bad = int((~read).sum())
        raise SourceError(f"{path}: depth holds {bad} NaN or inf pixels; write 0 where there is no reading")
    if float(depth_m.min(initial=0.0)) < 0.0:
        raise SourceError(f"{path}: depth is negative ({depth_m.min():.3f} m); write 0 where there is no reading")
    return depth_m


def without_nan(depth_m: NDArray[Any]) -> NDArray[np.float32]:
    """Return float depth with 0 for NaN (no reading) and infinity (out of range), see REP 117 of ROS."""
    return np.asarray(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0), np.float32)


def _refuse_missing(path: Path) -> None:
    if not path.is_file():
        raise SourceError(f"{path}: the image is missing; download it again or remove it from the list")


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
        get, cv2 = self._capture.get, self._cv2
        self.size = int(get(cv2.CAP_PROP_FRAME_WIDTH)), int(get(cv2.CAP_PROP_FRAME_HEIGHT))
        self.count, stated = int(get(cv2.CAP_PROP_FRAME_COUNT)), float(get(cv2.CAP_PROP_FPS))
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
        self._capture.set(self._cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # depth is not rotated either


FRAMES_PER_SECOND = 30.0
"""Frame rate of recordings without timestamps, by convention."""

COLOR_FOLDERS = ("color", "colour", "rgb", "image", "images")
DEPTH_FOLDERS = ("depth", "depths")
COLOR_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".tif", ".tiff", ".webp")
VIDEO_ENDINGS = (".mp4", ".mov", ".m4v", ".avi", ".webm", ".3gp", ".mts")
DEPTH_ENDINGS = (".png", ".pgm", ".pfm", ".tif", ".tiff", ".npy", ".npz", ".exr")

Key = TypeVar("Key", int, str)


def first_subfolder(folder: Path, names: Iterable[str]) -> Path | None:
    """Return the first of the named subfolders that exists, None if none does."""
    return next((folder / name for name in names if (folder / name).is_dir()), None)


NO_IMAGES = {"right", "vis", "viz", "preview", "mask", "masks", "confidence", "conf", "ir", "infrared", "normal"}
"""Words of names of folders and files that hold no colour or depth of the left or only camera."""


def named_as(paths: Iterable[Path], names: Iterable[str]) -> list[Path]:
    """Return the files or folders with one of the names as a word of theirs: image_left, JPEGImages, 0001-color."""
    words = [(p, {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", p.stem)}) for p in paths]
    return [path for path, found in words if found & {*names} and not found & NO_IMAGES]


def image_folder(folder: Path, names: Sequence[str]) -> Path | None:
    """Return the first of the named subfolders that exists, else the only one that is `named_as` they are, or None."""
    if (known := first_subfolder(folder, names)) or not folder.is_dir():
        return known
    found = named_as((path for path in folder.iterdir() if path.is_dir()), names)
    return found[0] if len(found) == 1 else None


def first_file(folder: Path, names: Iterable[str | Path]) -> Path | None:
    """Return the first of the named files (in the folder, or absolute) that exists, None if none does."""
    return next((folder / name for name in names if (folder / name).is_file()), None)


def list_images(folder: Path | None, endings: Sequence[str]) -> list[Path]:
    """Return the images of a folder in the order of the times in their names, else of the numbers: 2 before 10."""
    if folder is None or not folder.is_dir():
        return []
    entries = [path for path in folder.iterdir() if not path.name.startswith(".")]
    if len(entries) == 1 and entries[0].is_dir():  # Camera_0
        return list_images(entries[0], endings)
    paths = sorted((path for path in entries if path.suffix.lower() in endings), key=natural_key)
    return [paths[i] for i in np.argsort(times_of_names(paths)[0])]


def natural_key(path: Path | str) -> list[tuple[int, str]]:
    """Return a sort key that compares digits in a name as numbers and the rest as text."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", str(path)) if part]


def numbers_of_names(paths: Sequence[Path]) -> list[tuple[str, ...]]:
    """Return the numbers that differ in names that are alike otherwise, for each place in the names one per path."""
    stems = (re.sub(r"(?<!\d)(\d{10})[-_](\d{9})(?!\d)", r"\1.\2", path.stem) for path in paths)  # seconds and ns
    parts = [re.split(r"([0-9]+(?:\.[0-9]+)?)", stem) for stem in stems]
    alike = len({tuple(words[::2]) for words in parts}) == 1
    return [row for row in zip(*(words[1::2] for words in parts), strict=True) if len({*row}) > 1] if alike else []


def times_of_names(paths: Sequence[Path]) -> tuple[NDArray[np.float64], Origin]:
    """Return times [N], s, and their origin: read from names whose numbers can only be times (`seconds_of`), and have
    the order of the other numbers; else assumed to be 1/30 s apart."""
    columns = numbers_of_names(paths)
    rows = [[float(word) for word in row] for row in zip(*columns, strict=True)]
    for column in columns:
        times_s = seconds_of(np.array(column, np.float64), "." in "".join(column))
        if times_s is not None and sorted(rows) == [rows[i] for i in np.argsort(times_s)]:
            return times_s, Origin(f"{times_s.min():.3f} … {times_s.max():.3f} s", NAMED)
    return np.arange(len(paths)) / FRAMES_PER_SECOND, ASSUMED_TIMES


NAMED = "read from the names"
ASSUMED_TIMES = Origin("1/30 s apart", ASSUMED, "write rgb.txt and depth.txt with times")
DATES_S, STEPS_S = (946684800.0, 4102444800.0), (1 / 200, 2.0, 8.0)
"""The years 2000 to 2099, and median steps of the images of a recording; the longer one is for images with a date."""


def seconds_of(values: NDArray[np.float64], decimal: bool) -> NDArray[np.float64] | None:
    """Return numbers [N] in seconds if they can only be times in s, ms, µs or ns, by their steps and dates; else None.

    decimal: whether they have a point, and may be seconds from any start. Every n-th of numbered images is no time.
    """
    ordered = np.sort(values)
    steps = np.diff(ordered)
    if not len(steps) or not 0 < steps.min() <= steps.max() < 1e18:
        return None
    step = float(np.median(steps))
    nth = ordered[0] < 1e6 and step < 5000 and np.gcd.reduce(steps.astype(np.int64)) == step
    running = step > 9 and np.mean(np.abs(steps - step) <= step / 4) > 0.5 and not nth
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        dated = DATES_S[0] < ordered[0] * unit and ordered[-1] * unit < DATES_S[1]
        known = dated or (running and ordered[-1] * unit < 1e7) or (decimal and unit == 1.0)
        if known and STEPS_S[0] <= step * unit <= STEPS_S[1 + dated]:
            return values * unit
    return values if decimal and step > 1e-3 else None


def dated_seconds(times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return times [N] of a list in seconds: those in ms, µs or ns are recognised by their dates."""
    low, high = float(times.min(initial=np.inf)), float(times.max(initial=0.0))
    units = (unit for unit in (1e-3, 1e-6, 1e-9) if DATES_S[0] < low * unit and high * unit < DATES_S[1])
    return times * next(units, 1.0)


def index_by_number(paths: Iterable[Path]) -> dict[int, Path]:
    """Map the last number in each file name to its path, ascending; names without a number are left out. If the names
    are alike, it is the last number that differs: 8 of 008_16bit."""
    listed = list(paths)
    numbers = [re.findall(r"[0-9]+", path.stem)[-1:] for path in listed]
    if (columns := numbers_of_names(listed)) and "".join(columns[-1]).isdecimal():
        numbers = [[word] for word in columns[-1]]
    return dict(sorted((int(found[0]), path) for found, path in zip(numbers, listed, strict=True) if found))


def pair_images(
    folder: Path, colors: Mapping[Key, Path], depths: Mapping[Key, Path], color_name: str, depth_name: str
) -> tuple[list[Key], list[str]]:
    """Return the keys that colour and depth share, in the order of colour, and why the other images are left out.

    color_name, depth_name: file patterns for messages. Raises SourceError if one kind is missing or no key is shared.
    """
    if not depths:
        place = image_folder(folder, DEPTH_FOLDERS) or folder / Path(depth_name).parent
        found = sorted(path for path in place.glob(f"{Path(depth_name).stem}.*") if path.suffix and path.is_file())
        raise SourceError(
            f"no depth images in {place} (found {len(found)} other files, such as {found[0].name}); "
            f"export 16-bit PNG, or float metres (JPEG loses depth): {', '.join(DEPTH_ENDINGS)}"
            if found
            else f"no depth images in {folder} (looked for {depth_name}); is this the RGB-only download? "
            "see docs/data.md#without-depth"
        )
    if not colors:
        hint = "is the download complete? convert other images to JPEG, a video with: ffmpeg -i FILE color/%06d.png"
        raise SourceError(f"no colour images in {folder} (looked for {color_name}); {hint}")
    keys = [key for key in colors if key in depths]
    if not keys:
        first = f"{next(iter(colors.values())).name} and {next(iter(depths.values())).name}"
        raise SourceError(
            f"{folder}: {color_name} and {depth_name} have no number in common (found {first}); "
            "are both from one recording?"
        )
    return keys, [f"{colors[key]}: no {depth_name} with its number" for key in colors if key not in depths]


FrameFiles = dict[str, dict[int, Path]]

_NAME = re.compile(r"frame-([0-9]+)\.(?:(color)\.(?:png|jpe?g)|(depth)\.(?:png|pgm|tiff?)|(pose)\.txt)")


def frame_files(folder: Path) -> FrameFiles:
    """Map "color", "depth" and "pose" to the frame-N files of each kind by number, ascending."""
    found: FrameFiles = {"color": {}, "depth": {}, "pose": {}}
    for path in sorted(folder.glob("frame-*")):
        match = _NAME.fullmatch(path.name.lower())
        if match:
            kind = next(group for group in match.groups()[1:] if group)
            found[kind][int(match.group(1))] = path
    return found


def has_frame_files(folder: Path) -> bool:
    """Return whether there is at least one frame-N file."""
    return any(_NAME.fullmatch(path.name.lower()) for path in folder.glob("frame-*"))
