"""Convert images in memory to a `Frame`: numpy arrays or torch tensors of any usual type, from your own camera.

Every array is checked and copied, so the caller's buffers are never changed and can be used again at once. Each problem
is a SourceError of one line that says what was found and how to convert it.
"""

from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame, color_range, described
from sigmasplat.errors import SourceError
from sigmasplat.types import Matrix

ColorOrder = Literal["rgb", "bgr"]
Array = ArrayLike | torch.Tensor
"""A numpy array, a torch tensor, or what numpy converts to an array."""

UINT16_MAX = 65535
"""Several sensors write the largest 16-bit number for no reading."""
COLOR_MARGIN = 0.01
"""Colour may be outside [0, 1] by this much: filters that interpolate can overshoot."""
MEDIAN_DEPTH_M, MEDIAN_OF = (0.01, 100.0), 4096
"""If the median depth of an image is outside these limits, its unit is wrong; it is that of about so many pixels."""
LATEST_S = 1e11
"""A larger timestamp is not in seconds: this is the year 5138, and milliseconds passed it in 1973."""
NARROWEST = 0.05
"""A focal length below this share of the image width belongs to a normalised matrix."""


def color_from_bytes(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Convert 8-bit colour to float32 in [0, 1], same shape."""
    return np.asarray(values / np.float32(255.0))


def depth_from_integers(values: NDArray[Any], units_per_metre: float) -> NDArray[np.float32]:
    """Convert whole-number depth to float32 metres, same shape; 65535 becomes 0, no reading."""
    depth_m: NDArray[np.float32] = np.divide(values, units_per_metre, dtype=np.float64).astype(np.float32)
    depth_m[values == UINT16_MAX] = 0.0
    return depth_m


def frame_from_arrays(
    rgb: Array, depth: Array, K: Camera | Array, timestamp: float, *, index: int = 0, depth_scale: float | None = None,
    color_order: ColorOrder = "rgb", R_inertial_camera: Matrix | None = None, T_given_camera: Matrix | None = None,
) -> Frame:  # fmt: skip
    """Convert one pair of images to a `Frame`; the arrays are copied.

    rgb [H, W, 3]: uint8, or float in [0, 1]; its channels are in `color_order`. depth [H, W]: along the optical axis, 0
    = no reading; float in metres, or whole numbers with `depth_scale`, the units per metre (1000 for millimetres). K:
    of the undistorted images, a 3×3 matrix, (fx, fy, cx, cy) in pixels, or a `Camera`. timestamp: seconds.
    R_inertial_camera, T_given_camera: as in `Frame`. Raises SourceError with the remedy if an argument has the wrong
    type, shape, unit or range, and ConfigError if K is not a camera.
    """
    if color_order not in get_args(ColorOrder):
        raise SourceError(f"color_order is {color_order!r}; give 'rgb' or 'bgr'")
    color = color_from_array(rgb, color_order)
    depth_m = depth_from_array(depth, depth_scale)
    camera = camera_from(K, color.shape[1], color.shape[0])
    frame = Frame(index, seconds_from(timestamp), color, depth_m, camera, R_inertial_camera, None, T_given_camera)
    _check_unit(frame, depth_scale)
    return frame


def color_from_array(rgb: Array, color_order: ColorOrder = "rgb") -> NDArray[np.float32]:
    """Convert colour to new float32 [H, W, 3], RGB. Raises SourceError on another shape or type."""
    values = _array("colour", rgb)
    shape, name = values.shape, f"colour is {described(values)}"
    if values.ndim != 3 or shape[2] != 3 or 0 in shape:
        raise SourceError(
            f"{name}; give one image [H, W, 3], three channels last: numpy.stack([gray] * 3, axis=-1) for a gray one, "
            "rgb[..., :3] with an alpha channel, rgb.transpose(1, 2, 0), or rgb.permute(1, 2, 0), with channels first"
        )
    if color_order == "bgr":
        values = values[..., ::-1]
    if values.dtype == np.uint8:
        return color_from_bytes(np.ascontiguousarray(values))
    if values.dtype.kind != "f":
        raise SourceError(f"{name}; give uint8, or float in 0…1")
    color = _float32(values)
    low, high = float(color.min()), float(color.max())
    if low < -COLOR_MARGIN or high > 1.0 + COLOR_MARGIN:  # false for NaN, which `Frame` refuses
        raise SourceError(color_range(low, high))
    return color


def depth_from_array(depth: Array, depth_scale: float | None = None) -> NDArray[np.float32]:
    """Convert depth to new float32 metres [H, W]; depth_scale: units per metre. Raises SourceError on another shape or
    type, and on whole numbers without `depth_scale`."""
    values = _array("depth", depth)
    name = f"depth is {described(values)}"
    if values.ndim != 2 or 0 in values.shape:
        raise SourceError(f"{name}; give one image [H, W]: depth.squeeze() (a picture of depth in colours holds none)")
    if values.dtype.kind == "b" or values.dtype == np.uint8:
        raise SourceError(f"{name}; 8 bits hold no metric depth: give uint16 with depth_scale, or float metres")
    is_number = isinstance(depth_scale, int | float | np.number)
    if depth_scale is not None and not (is_number and 1 <= depth_scale < np.inf):
        found = f"{depth_scale:g}" if is_number else described(depth_scale)
        raise SourceError(f"depth_scale is {found}; give the units per metre, at least 1 (1000 for millimetres)")
    if values.dtype.kind == "f":
        return _float32(values if depth_scale is None else values / np.float64(depth_scale))
    if depth_scale is None:
        raise SourceError(f"{name}, whole numbers; give depth_scale, the units per metre (1000 for millimetres)")
    return depth_from_integers(values, depth_scale)


def camera_from(K: Camera | Array, width: int, height: int) -> Camera:
    """Convert the intrinsics of images of width × height pixels to a `Camera`.

    K: a 3×3 matrix (or its 9 numbers by rows), (fx, fy, cx, cy), or a `Camera`. Raises SourceError if it has another
    form or is for images of another size, and ConfigError if it is not a camera.
    """
    if isinstance(K, Camera):
        if (K.width, K.height) != (width, height):
            raise SourceError(f"colour is {width}×{height}, but the camera is for {K.width}×{K.height}; see resized")
        return K
    values = _array("K", K).astype(np.float64)
    if values.shape == (4,):
        fx, fy, cx, cy = values.tolist()
    elif values.shape in ((3, 3), (9,)):
        (fx, skew, cx), (zero, fy, cy), last = values.reshape(3, 3).tolist()
        if skew or zero or last != [0.0, 0.0, 1.0]:
            raise SourceError(f"K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: {values.reshape(3, 3).tolist()}")
    else:
        raise SourceError(f"K has the shape {list(values.shape)}; give a 3×3 matrix or (fx, fy, cx, cy) in pixels")
    camera = Camera(width, height, fx, fy, cx, cy)
    if fx < NARROWEST * width or not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise SourceError(
            f"K has fx = {fx:g} and its principal point at ({cx:g}, {cy:g}), but the images are {width}×{height}; give "
            "pixels of this image size, not normalised coordinates, or a Camera if that is correct"
        )
    return camera


def seconds_from(timestamp: float) -> float:
    """Convert a timestamp to seconds. Raises SourceError if it is not a finite number of seconds."""
    try:
        time_s = float(timestamp)
    except (TypeError, ValueError):
        time_s = float("nan")
    if not abs(time_s) <= LATEST_S:
        found = timestamp if isinstance(timestamp, int | float) else described(timestamp)
        raise SourceError(f"timestamp is {found}; give seconds as one finite number (divide nanoseconds by 1e9)")
    return time_s


def _array(name: str, values: Any) -> NDArray[Any]:
    """Return values as a numpy array, without a copy if possible. Raises SourceError if they are not numbers."""
    if values is None:
        raise SourceError(f"{name} is None; give an array (did the camera or the file give no image?)")
    try:
        if isinstance(values, torch.Tensor):
            whole = values.detach().cpu()
            return (whole.float() if whole.dtype == torch.bfloat16 else whole).numpy()
        found = np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as problem:
        raise SourceError(f"{name} is {described(values)}, not an array ({problem})") from problem
    if found.dtype.kind not in "buif":
        raise SourceError(f"{name} is {described(values)}; give numbers in a numpy array or a torch tensor")
    return found


def _float32(values: NDArray[Any]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):  # `Frame` refuses inf
        return np.array(values, np.float32, order="C")


def _check_unit(frame: Frame, depth_scale: float | None) -> None:
    """Raise SourceError if the median depth shows that the unit is wrong."""
    some = frame.depth_m.reshape(-1)[:: max(1, frame.depth_m.size // MEDIAN_OF)]
    readings = some[some > 0]
    if not len(readings) or MEDIAN_DEPTH_M[0] <= (median_m := float(np.median(readings))) <= MEDIAN_DEPTH_M[1]:
        return
    remedy = "if it is in millimetres, give depth_scale=1000" if depth_scale is None else "correct depth_scale"
    raise SourceError(f"the median depth is {median_m:.4g} m; {remedy} (units per metre)")
