"""Read the calibration of a recording, and check it."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.config.ranges import kinds_of, problem_of
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.errors import ConfigError, SourceError
from sigmasplat.files.reading import exists, read_json

Distortion = tuple[float, ...]
"""Radial and tangential distortion k1, k2, p1, p2, k3 [, k4, k5, k6 of the rational model's denominator]."""


GIVEN, MEASURED, ASSUMED = "given", "measured", "assumed"
ALONG_RAY = "along the ray, converted to z"
"""Words for depth that is converted when it is read."""


class Origin(NamedTuple):
    """A value that decides the result, in words, and where it comes from: given, measured, assumed, or "read from
    FILE"; option: what gives it, if it is assumed."""

    value: str
    origin: str
    option: str = ""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The cameras of a recording.

    camera, distortion: of the colour image, None for no distortion; depth_units_per_metre: of whole-number depth;
    depth_camera, depth_distortion: of depth images that are not registered to colour, None if they are registered;
    T_color_depth [4, 4]: transforms points of the depth camera to the colour camera, metres;
    sensor: the depth sensor (`config.input`), None if it is unknown; origins: of these values, by name; own: the camera
    of each frame, if they differ, from which its images are resampled.
    """

    camera: Camera
    depth_units_per_metre: float
    distortion: Distortion | None = None
    depth_camera: Camera | None = None
    depth_distortion: Distortion | None = None
    T_color_depth: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    sensor: str | None = None
    origins: Mapping[str, Origin] = field(default_factory=dict)
    own: tuple[Camera, ...] = ()


def published(
    name: str, camera: Camera, units_per_metre: float, distortion: Distortion | None = None, **more: Any
) -> Calibration:
    """Return the published calibration of a camera, which a recording is assumed to be from; name: its origin, in
    words; more: other fields of `Calibration`."""
    origins = {"camera": Origin(name, ASSUMED, "--calibration FILE")}
    return Calibration(camera, units_per_metre, distortion, origins=origins, **more)


class CameraUnknown(SourceError):
    """Neither the recording nor the user gives a focal length; `size` is (width, height) of the images."""

    def __init__(self, size: tuple[int, int], message: str) -> None:
        super().__init__(message)
        self.size = size


DEFINED = Origin("", "defined by the format")
MOST_NUMBER = 1e100
"""Larger numbers are refused: their squares are not finite, and no field of a recording needs them."""

TUM_UNITS_PER_METRE, MM_PER_METRE = 5000.0, 1000.0

# The values published with the TUM RGB-D benchmark (CG-SLAM's loaders use the same), 640×480.
FREIBURG = {
    "1": Calibration(Camera(640, 480, 517.3, 516.5, 318.6, 255.3), TUM_UNITS_PER_METRE,
                     (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": Calibration(Camera(640, 480, 520.9, 521.0, 325.1, 249.7), TUM_UNITS_PER_METRE,
                     (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": Calibration(Camera(640, 480, 535.4, 539.2, 320.1, 247.6), TUM_UNITS_PER_METRE),
}  # fmt: skip


def freiburg_calibration(folder: Path) -> Calibration | None:
    """Return the TUM camera named by the folder or a parent (`freiburg1` or `fr1` in the name), else None."""
    for part in reversed(folder.resolve().parts):
        match = re.search(r"freiburg([123])|(?:^|[^a-z0-9])fr([123])(?:[^0-9]|$)", part.lower())
        if match:
            known = FREIBURG[number := match.group(1) or match.group(2)]
            name = f"TUM's freiburg{number}, named by {part}"
            return published(name, known.camera, known.depth_units_per_metre, known.distortion)
    return None


def read_calibration(
    path: Path, size: tuple[int, int], default_units_per_metre: float, known: Calibration | None = None
) -> Calibration:
    """Read `calibration.json`: fx, fy, cx, cy; optional width, height, depth_scale (PNG units per metre), distortion,
    sensor (`config.input`). If the recording's own calibration is `known`, each of them is optional.

    For depth that is not registered to colour: depth_camera, an object of the same fields, and T_color_depth, 4 rows.
    `size` (width, height) in pixels is the default for a missing size. Raises SourceError naming file and field.
    """
    written, read = read_json_object(path), Origin("", f"read from {path}")
    fields = (asdict(known.camera) if known else {}) | written
    default = known.depth_units_per_metre if known else default_units_per_metre
    sensor = written.get("sensor", known.sensor if known else None)
    if sensor and (problem := problem_of(kinds_of(InputConfig)["sensor"], sensor)):
        raise SourceError(f'{path}: field "sensor" {problem}')
    origins = dict(known.origins if known else {})
    origins |= {"camera": read} if written.keys() & {"fx", "fy", "cx", "cy"} else {}
    origins |= {"depth unit": read} if "depth_scale" in written else {}
    if "camera" in origins and "fx" in written and not {"width", "height"} <= written.keys():
        origins["size of the calibration"] = Origin("that of the images", ASSUMED, f"width and height in {path}")
    camera, scale = read_camera(path, fields, size), positive_number(path, fields, "depth_scale", default)
    lens = known.distortion if known and "distortion" not in written else read_distortion(path, written)
    calibration = replace(
        known or Calibration(camera, scale), camera=camera, depth_units_per_metre=scale, distortion=lens,
        sensor=sensor, origins=origins,
    )  # fmt: skip
    inner = written.get("depth_camera")
    if inner is None:
        return calibration
    if not isinstance(inner, dict):
        raise SourceError(f'{path}: field "depth_camera" is {inner!r}, expected an object with fx, fy, cx, cy')
    camera, lens = read_camera(path, inner, size), read_distortion(path, inner)
    T_color_depth = read_rigid_transform(path, written, "T_color_depth")
    return replace(calibration, depth_camera=camera, depth_distortion=lens, T_color_depth=T_color_depth)


OURS = {"fx", "fy", "cx", "cy", "depth_scale", "distortion", "sensor", "depth_camera", "T_color_depth", "baseline_m"}


def own_calibration(folder: Path) -> Path | None:
    """Return calibration.json of a folder; None without one, or if another program wrote it. Raises SourceError."""
    path = folder / "calibration.json"
    written = read_json(path) if exists(path) else {}
    return None if isinstance(written, dict) and not written.keys() & OURS else path


def resolve_calibration(
    folder: Path, recorded: Calibration | None, size: tuple[int, int], settings: InputConfig, default_units: float
) -> Calibration:
    """Return the calibration to use: from the settings, else from calibration.json, else from the recording.

    `folder` is the recording, a folder or a file; `size` (width, height) is that of the colour image. Raises
    CameraUnknown if no focal length is given.
    """
    if file := settings.calibration or own_calibration(folder):
        recorded = read_calibration(Path(file), size, default_units, recorded)
    if recorded is None and not settings.fx:
        place = "a file for --calibration" if folder.is_file() else folder / "calibration.json"
        raise CameraUnknown(
            size,
            f"camera unknown: {folder} has no intrinsics; write {place} with fx, fy, cx, cy, "
            "depth_scale (PNG units per metre), or give --fx PIXELS (and --fy, --cx, --cy, --depth-scale)",
        )
    if recorded is None:
        centred = Camera(*size, settings.fx, settings.fy or settings.fx, (size[0] - 1) / 2, (size[1] - 1) / 2)
        recorded = Calibration(centred, default_units)
        if not (settings.cx and settings.cy):
            middle = Origin("the middle of the image", ASSUMED, "--cx PX --cy PX")
            recorded = replace(recorded, origins={"image centre": middle})
    units = settings.depth_scale or recorded.depth_units_per_metre
    given = {key: value for key in ("fx", "fy", "cx", "cy") if (value := getattr(settings, key))}
    found = replace(recorded, camera=replace(recorded.camera, **given), depth_units_per_metre=units)
    return replace(found, origins=_origins(found, bool(given), bool(settings.depth_scale)))


def _origins(found: Calibration, camera_given: bool, units_given: bool) -> dict[str, Origin]:
    """Return the origins of all values of a calibration, in words; what nothing states is assumed."""
    c, known = found.camera, dict(found.origins)
    origins = {"camera": known.pop("camera", Origin("", "read from the recording"))}
    if camera_given:
        origins["camera"] = Origin("", GIVEN)
    if not origins["camera"].value:
        words = f"fx {c.fx:.6g}, fy {c.fy:.6g}, cx {c.cx:.6g}, cy {c.cy:.6g} pixels"
        origins["camera"] = origins["camera"]._replace(value=words)
        if not found.distortion:
            origins["lens"] = Origin("no distortion", ASSUMED, "distortion in calibration.json")
        if not found.depth_camera:
            option = "depth_camera and T_color_depth in calibration.json"
            origins["depth and colour"] = Origin("one camera, registered", ASSUMED, option)
    units = f"{found.depth_units_per_metre:g} per metre"
    other = {TUM_UNITS_PER_METRE: f"{MM_PER_METRE:g}, if in mm", MM_PER_METRE: f"{TUM_UNITS_PER_METRE:g}, if TUM's"}
    option = f"--depth-scale {other.get(found.depth_units_per_metre, 'UNITS')}"
    unit = known.pop("depth unit", Origin("", ASSUMED, option))
    unit = Origin("", GIVEN) if units_given else unit
    return origins | {"depth unit": unit._replace(value=units)} | known


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds one object. Raises SourceError naming the file."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise SourceError(f"{path}: holds a {type(content).__name__}, not an object with fx, fy, cx, cy")
    return content


def json_number(path: Path, fields: dict[str, Any], key: str, default: float | None = None) -> float:
    """Return one finite number of a JSON object. Raises SourceError naming file and field."""
    value = fields.get(key, default)
    if value is None:
        raise SourceError(f'{path}: field "{key}" is missing (found {", ".join(sorted(fields)) or "nothing"}); add it')
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MOST_NUMBER:
        raise SourceError(f'{path}: field "{key}" is {str(value)[:60]}, expected a finite number')
    return float(value)


def positive_number(path: Path, fields: dict[str, Any], key: str, default: float | None = None) -> float:
    """Return a number as `json_number` does. Raises SourceError too if it is not above 0."""
    if (value := json_number(path, fields, key, default)) <= 0:
        raise SourceError(f'{path}: field "{key}" is {value:g}, it must be above 0')
    return value


def build_camera(path: Path, width: int, height: int, focal: list[float]) -> Camera:
    """Build a camera from values of a file. Raises SourceError naming the file if they are not valid."""
    try:
        return Camera(width, height, *focal)
    except ConfigError as error:
        raise SourceError(f"{path}: {error}") from error


SAME_CAMERA = 0.015
"""Autofocus changes intrinsics by less than this share of fx; images that differ more are resampled to one camera."""


def median_calibration(path: Path, size: tuple[int, int], focals: Any, units: float) -> Calibration:
    """Build the camera with the median of fx, fy, cx, cy [N, 4] of the frames. Raises SourceError if one is invalid."""
    middle = np.median(focals, 0).tolist()
    share = float(np.abs(np.subtract(focals, middle)).max()) / middle[0]
    said = f"{MEASURED}, median of {len(focals)} frames, they differ by {100 * share:.1f} %"
    own = tuple(build_camera(path, *size, [*focal]) for focal in focals if share > SAME_CAMERA)
    origin = Origin("", said + ", resampled" * bool(own) if share > 1e-6 else f"read from {path}")
    return Calibration(build_camera(path, *size, middle), units, origins={"camera": origin}, own=own)


POSSIBLE_VIEW_DEG = (2.0, 170.0)
"""A pinhole image with a field of view outside this range is taken for a mistake in the calibration."""
USUAL_VIEW_DEG, CENTRED = (25.0, 120.0), 0.2
"""Horizontal field of view of depth cameras and phones; principal points are usually within this share of the image
size from its centre."""


def refuse_impossible_camera(name: str, camera: Camera) -> None:
    """Raise SourceError if the intrinsics cannot be those of a camera with such images."""
    low, high = POSSIBLE_VIEW_DEG
    for axis, focal, size in (("x", camera.fx, camera.width), ("y", camera.fy, camera.height)):
        if not low <= (degrees := float(np.degrees(2 * np.arctan(0.5 * size / focal)))) <= high:
            raise SourceError(
                f"{name}: f{axis} = {focal:g} pixels gives a field of view of {degrees:.3g}°; "
                f"correct the calibration, or give --f{axis} PIXELS"
            )
    if not (-0.5 <= camera.cx <= camera.width - 0.5 and -0.5 <= camera.cy <= camera.height - 0.5):
        raise SourceError(
            f"{name}: the principal point ({camera.cx:g}, {camera.cy:g}) is outside the image of "
            f"{camera.width}×{camera.height}; correct the calibration, or give --cx and --cy"
        )


def unlikely_camera(camera: Camera) -> str | None:
    """Return a warning if the intrinsics are unusual, None if they are plausible."""
    degrees, (low, high) = float(np.degrees(camera.width_rad)), USUAL_VIEW_DEG
    if not low <= degrees <= high:
        return f"the field of view is {degrees:.0f}°, which is unusual for a depth camera; check fx"
    if not 0.8 <= camera.fx / camera.fy <= 1.25:
        return f"fx = {camera.fx:g} and fy = {camera.fy:g} differ; pixels are usually square: check both"
    x, y = camera.cx - (camera.width - 1) / 2, camera.cy - (camera.height - 1) / 2
    turned_x, turned_y = camera.cx - (camera.height - 1) / 2, camera.cy - (camera.width - 1) / 2
    if max(abs(turned_x), abs(turned_y)) < 0.25 * max(abs(x), abs(y)) > 0.01 * camera.width:
        return (
            f"the principal point ({camera.cx:g}, {camera.cy:g}) fits an image of {camera.height}×{camera.width}, "
            f"these are {camera.width}×{camera.height}; give the camera of the turned images: --fx, --fy, --cx, --cy"
        )
    if abs(x) > CENTRED * camera.width or abs(y) > CENTRED * camera.height:
        return f"the principal point is ({x:+.0f}, {y:+.0f}) pixels from the image centre; check cx and cy"
    return None


def read_camera(path: Path, fields: dict[str, Any], size: tuple[int, int]) -> Camera:
    """Read fx, fy, cx, cy and width, height, by default `size`. Raises SourceError naming file and field."""
    width, height = json_number(path, fields, "width", size[0]), json_number(path, fields, "height", size[1])
    return build_camera(
        path, int(width), int(height), [json_number(path, fields, key) for key in ("fx", "fy", "cx", "cy")]
    )  # fmt: skip


def read_rigid_transform(path: Path, fields: dict[str, Any], key: str) -> NDArray[np.float64]:
    """Read a transform, identity if absent. Raises SourceError unless it is a rigid 4×4 matrix."""
    try:
        T = np.array(fields.get(key, np.eye(4)), np.float64)
    except (ValueError, TypeError):
        T = np.zeros(0)
    if T.shape != (4, 4) or not se3.is_rigid(T):
        raise SourceError(f'{path}: field "{key}" is not a rigid 4×4 matrix by rows, metres')
    return T


def read_distortion(path: Path, fields: dict[str, Any]) -> tuple[float, ...] | None:
    """Read distortion [k1, k2, p1, p2, k3], None if it is absent or 0. Raises SourceError naming file and field."""
    values = fields.get("distortion")
    if values is None:
        return None
    if not isinstance(values, list) or len(values) not in (4, 5):
        raise SourceError(f'{path}: field "distortion" is {values!r}, expected [k1, k2, p1, p2, k3]')
    numbers = [json_number(path, {"distortion": v}, "distortion") for v in [*values, 0.0][:5]]
    return tuple(numbers) if any(numbers) else None
