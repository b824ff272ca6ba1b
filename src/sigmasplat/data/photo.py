"""The colour image of a keyframe at the camera's own size: a JPEG file in memory, for refinement of the final map."""

from dataclasses import dataclass
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Frame
from sigmasplat.data.resizing import interpolated_depth, resized_color

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
