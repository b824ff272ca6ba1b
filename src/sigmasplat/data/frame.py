"""One RGB-D image: immutable, checked on construction, without ground truth; its photo as JPEG."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.images import interpolated_depth, resized_color, resized_depth, within
from sigmasplat.errors import SourceError
from sigmasplat.types import Matrix

COLOR_LIMITS = (-1.0, 2.0)
"""Colour outside these limits has another unit, usually 0…255. Values just outside [0, 1] are accepted."""


@dataclass(frozen=True, eq=False)
class Detail:
    """The gray image of a frame, uint8 [H, W], at its own size (or reduced to a maximum width), and its pinhole.

    Features are found in it: the working image is too small for them.
    """

    gray: NDArray[np.uint8]
    camera: Camera


class PosePrior(NamedTuple):
    """What is known of a frame's pose apart from its images: `R_inertial_camera` and `T_given_camera` of `Frame`."""

    R_inertial_camera: Matrix | None = None
    T_given_camera: Matrix | None = None


NO_PRIOR = PosePrior()


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of colour and depth.

    color: float32 [H, W, 3] in [0, 1]; depth_m: float32 [H, W] along the optical axis in metres, 0 = no reading;
    camera: the pinhole of both; timestamp_s: seconds; index: position in the source; R_inertial_camera [3, 3]: rotation
    from the camera's axes to fixed axes, the same for all frames, measured by a gyroscope; None = not measured. Only
    the rotation between two frames is used, so any fixed axes will do; ignored: pixels of the frame as it was read
    (`ignored_by` resamples them) whose colour is not used either, None = none; they have no depth; T_given_camera
    [4, 4]: pose of the camera in fixed axes, metres, which is used as it is; None = the pose is estimated. Only the
    motion between two frames is used; specific_force_m_s2 [3]: measured by an accelerometer along the camera's axes,
    9.81 upwards at rest, from which a run finds the vertical direction; None = not measured; depth_late_s: time of the
    depth image after the colour image, as the files say. The frame keeps read-only views of the arrays and does not
    copy them: do not write to them later (`frame_from_arrays` copies). Raises SourceError if an array is not float32,
    on inconsistent shapes, values that are not finite, colour in 0…255, negative depth, a matrix that is not a
    rotation, a pose that is not rigid, or a force that is not three finite numbers.
    """

    index: int
    timestamp_s: float
    color: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    camera: Camera
    R_inertial_camera: Matrix | None = None
    ignored: NDArray[np.bool_] | None = None
    T_given_camera: Matrix | None = None
    specific_force_m_s2: NDArray[np.float64] | None = None
    depth_late_s: float = 0.0

    def __post_init__(self) -> None:
        for problem in self._problems():
            raise SourceError(f"frame {self.index}: {problem}")
        self._keep(self.color, self.depth_m)

    def _problems(self) -> Iterator[str]:
        """Yield what is wrong with the frame. Each check needs those before it."""
        for name, array in (("colour", self.color), ("depth", self.depth_m)):
            if not isinstance(array, np.ndarray) or array.dtype != np.float32:
                yield (
                    f"{name} is {described(array)}; give numpy float32, or use Slam.track or frame_from_arrays, which "
                    "convert other arrays"
                )
        size = (self.camera.height, self.camera.width)
        if self.color.shape != (*size, 3) or self.depth_m.shape != size:
            yield (
                f"colour is {self.color.shape}, depth is {self.depth_m.shape}, the camera is {size[1]}×{size[0]}; "
                "register depth to colour and give both one size"
            )
        low, high = float(self.color.min()), float(self.color.max())  # both are NaN if a value is NaN
        nearest_m, farthest_m = float(self.depth_m.min()), float(self.depth_m.max())
        for name, values in (("colour", (low, high)), ("depth", (nearest_m, farthest_m))):
            if not np.isfinite(values).all():
                yield f"{name} holds NaN or inf; write 0 where there is no reading"
        if low < COLOR_LIMITS[0] or high > COLOR_LIMITS[1]:
            yield color_range(low, high)
        if nearest_m < 0.0:
            yield f"depth is negative ({nearest_m:.3f} m); 0 means no reading"
        force = self.specific_force_m_s2
        if self.R_inertial_camera is not None and not se3.is_rotation(self.R_inertial_camera):
            yield "R_inertial_camera is not a rotation [3, 3]; give None if it is not measured"
        if self.T_given_camera is not None and not se3.is_rigid(self.T_given_camera):
            yield "T_given_camera is not a rigid pose [4, 4]; give None if it is to be estimated"
        if force is not None and not (np.shape(force) == (3,) and np.isfinite(force).all()):
            yield "specific_force_m_s2 is not three finite numbers; give None if it is not measured"

    @property
    def prior(self) -> PosePrior:
        """Return what is known of the pose apart from the images."""
        return PosePrior(self.R_inertial_camera, self.T_given_camera)

    def _keep(self, color: NDArray[np.float32], depth_m: NDArray[np.float32]) -> None:
        """Keep read-only views of the images; the caller's arrays stay writeable."""
        for name, array in (("color", color), ("depth_m", depth_m)):
            view = np.ascontiguousarray(array).view()
            view.setflags(write=False)
            object.__setattr__(self, name, view)

    def resized(self, width: int, height: int) -> "Frame":
        """Return the frame at another size: colour averaged over the pixel's area, depth by `resized_depth`."""
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        color, depth_m = resized_color(self.color, width, height), resized_depth(self.depth_m, width, height)
        return self._with_images(color, depth_m, self.camera.resized(width, height))

    def prepared(self, width: int, min_depth_m: float, max_depth_m: float, crop_px: int = 0) -> "Frame":
        """Return the working frame: the size of `Camera.prepared`, and depth 0 outside the range.

        Raises ConfigError if no pixel would remain after the crop.
        """
        camera = self.camera.prepared(width, crop_px)
        size = camera.width + 2 * crop_px, camera.height + 2 * crop_px
        if size == (self.camera.width, self.camera.height):
            color, depth_m = self.color, within(self.depth_m, min_depth_m, max_depth_m)
        else:
            color = resized_color(self.color, *size)
            depth_m = resized_depth(self.depth_m, *size, min_depth_m, max_depth_m)
        if color is self.color and depth_m is self.depth_m and not crop_px:
            return self
        inner = np.s_[crop_px : crop_px + camera.height, crop_px : crop_px + camera.width]
        return self._with_images(color[inner], depth_m[inner], camera)

    def with_depth(self, depth_m: NDArray[np.float32]) -> "Frame":
        """Return the frame with depth that was made from its own."""
        return self._with_images(self.color, depth_m, self.camera)

    def _with_images(self, color: NDArray[np.float32], depth_m: NDArray[np.float32], camera: Camera) -> "Frame":
        """Return the frame with images that were made from its own: their values need no check."""
        frame = copy.copy(self)
        object.__setattr__(frame, "camera", camera)
        frame._keep(color, depth_m)
        return frame

    def ignored_by(self, camera: Camera) -> NDArray[np.bool_] | None:
        """Return the ignored pixels as a camera with other intrinsics at the same pose sees them, by the nearest pixel;
        None without any. This frame must be as it was read."""
        if self.ignored is None or not self.ignored.any():
            return None
        columns, rows = (np.rint(pixels).astype(np.intp) for pixels in camera.pixels_in(self.camera))
        height, width = self.ignored.shape
        return np.asarray(self.ignored[np.clip(rows, 0, height - 1)][:, np.clip(columns, 0, width - 1)])

    def seen_by(self, camera: Camera) -> "Frame":
        """Return the frame as a camera with other intrinsics at the same pose sees it: a homography, exact for depth.

        Colour is averaged if the new pixels are larger, and interpolated; depth is that of the nearest pixel. Pixels
        outside the frame have depth 0 and the colour of its edge.
        """
        size = self.camera.width, self.camera.height
        scales = (camera.fx / self.camera.fx, camera.fy / self.camera.fy)
        width, height = (max(1, round(n * min(scale, 1.0))) for n, scale in zip(size, scales, strict=True))
        columns, rows = camera.pixels_in(self.camera.resized(width, height))
        color = _interpolated(_interpolated(resized_color(self.color, width, height), rows).swapaxes(0, 1), columns)
        u, v = (np.rint(pixels) for pixels in camera.pixels_in(self.camera))
        color = np.ascontiguousarray(color.swapaxes(0, 1))
        return replace(self, color=color, depth_m=_at(self.depth_m, v, u), camera=camera)


def described(value: object) -> str:
    """Return the type of a value in words, of an array its dtype and shape."""
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    kind = "None" if value is None else type(value).__name__
    return kind if dtype is None or shape is None else f"{kind} {dtype} {list(shape)}"


def color_range(low: float, high: float) -> str:
    """Return what to say of colours from `low` to `high` if they are not in [0, 1]."""
    return f"colour is from {low:g} to {high:g}; give float values in 0…1 (divide by 255), or uint8"


def _interpolated(color: NDArray[np.float32], rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return colour at rows that are not whole numbers; beyond the first and the last row it is theirs."""
    at = np.clip(rows, 0, len(color) - 1)
    above = np.minimum(at.astype(np.intp), max(len(color) - 2, 0))
    share = (at - above).astype(np.float32)[:, None, None]
    below = np.minimum(above + 1, len(color) - 1)
    return np.asarray((1 - share) * color[above] + share * color[below], np.float32)


JPEG_QUALITY = 95
"""Errors of 48 dB PSNR, far below those of any map, at 110 kB for 640×480 pixels. A WebP file of this quality is a
third smaller, but takes 7 times as long to write."""


@dataclass(frozen=True, eq=False)
class Photo:
    """The colour of a frame at the camera's own size as a JPEG file, uint8 [bytes], and its pinhole.

    Depth is not kept: sensors measure it with less detail than colour, and that of the working image also shows which
    pixels must not be used.
    """

    jpeg: NDArray[np.uint8]
    camera: Camera

    @staticmethod
    def of(frame: Frame, camera: Camera, crop_px: int = 0) -> "Photo":
        """Compress the colour of a frame, resized to `camera`, which has lost `crop_px` pixels at each edge."""
        color = resized_color(frame.color, camera.width + 2 * crop_px, camera.height + 2 * crop_px)
        inner = color[crop_px : crop_px + camera.height, crop_px : crop_px + camera.width]
        values, file = (inner * np.float32(255.0) + np.float32(0.5)).astype(np.uint8), BytesIO()
        Image.fromarray(values).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
        return Photo(np.frombuffer(file.getvalue(), np.uint8), camera)

    def color(self) -> NDArray[np.uint8]:
        """Return the colour, uint8 [H, W, 3]."""
        return np.asarray(Image.open(BytesIO(self.jpeg.tobytes())).convert("RGB"))

    def frame(self, depth_m: NDArray[np.float32], working: Camera, camera: Camera) -> Frame:
        """Return the image with depth, as `camera` sees it; depth_m [h, w]: that of the same frame in the `working`
        camera, m."""
        color = self.color().astype(np.float32) / np.float32(255.0)
        enlarged = enlarged_depth(depth_m, working, self.camera)
        frame = Frame(0, 0.0, color, enlarged, self.camera)
        return frame if camera == self.camera else frame.seen_by(camera)


def photo_size(camera: Camera, input_width: int, crop_px: int, width: int) -> tuple[Camera, int] | None:
    """Return the camera of photos and the pixels cropped at their edges; None if they are not larger than the working
    images.

    camera: of the recording; input_width, crop_px: `Camera.prepared` makes the working camera with these. Photos are
    `width` pixels wide before the crop, but not wider than `camera`.
    """
    wide, working = min(width, camera.width), input_width or camera.width
    if wide <= working:
        return None
    crop = round(crop_px * wide / working)
    return camera.prepared(wide, crop), crop


def enlarged_depth(depth_m: NDArray[np.float32], camera: Camera, larger: Camera) -> NDArray[np.float32]:
    """Return depth [h, w], m, at the pixels of a larger camera [H, W] of the same view.

    Depth is interpolated where the four readings around a pixel are on one surface (`SAME_SURFACE`). Elsewhere it is
    that of the nearest pixel, 0 without a reading or outside the image.
    """
    columns, rows = larger.pixels_in(camera)
    return interpolated_depth(depth_m, rows, columns, _at(depth_m, np.rint(rows), np.rint(columns)))


def _at(depth_m: NDArray[np.float32], rows: NDArray[np.float64], columns: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return depth at whole rows [H] and columns [W]; 0 outside the image."""
    (h, w), row, column = depth_m.shape, rows.astype(np.intp), columns.astype(np.intp)
    inside = ((row >= 0) & (row < h))[:, None] & (column >= 0) & (column < w)
    found = depth_m[np.clip(row, 0, h - 1)][:, np.clip(column, 0, w - 1)]
    return np.where(inside, found, np.float32(0.0))
