"""Prepare a frame for a fit: image planes with the same padding as the view's; gray images."""

from dataclasses import dataclass, field as dataclass_field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import correlate, minimum_filter
from torch import Tensor

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Detail, Frame, Photo
from sigmasplat.data.readout import Readout, read_at_once
from sigmasplat.data.submap import Picture
from sigmasplat.fit.adam import VectorAdam
from sigmasplat.native import _core

Image = NDArray[np.float32]
LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def gray_of(color: Image) -> Image:
    """Return the luma [H, W] of colour [H, W, 3]."""
    if color.dtype != np.float32 or not color.flags.c_contiguous:
        return np.asarray(color @ LUMA)
    gray = np.empty(color.shape[:-1], np.float32)
    _core.gray(color, LUMA.tolist(), gray)
    return gray


def luma(color: Tensor) -> Tensor:
    """Return the luma [H, W] of colour planes [3, H, W], on their device."""
    red, green, blue = map(float, LUMA)
    gray: Tensor = red * color[0] + green * color[1] + blue * color[2]
    return gray


BLOCKS, EDGE_FACTOR = 32, 4.0
SCHARR = np.array([[3, 10, 3], [0, 0, 0], [-3, -10, -3]], np.float32) / 32
NEARLY_BLACK = 0.01


def textured(color: Image) -> NDArray[np.bool_]:
    """Return the pixels [H, W] of colour [H, W, 3] whose gradient is above 4 times the median of their block, in a grid
    of 32 × 32 blocks; not beside a pixel that is nearly black (VarSplat's code, registration)."""
    gray = color.mean(-1)
    lit = minimum_filter(gray, 3, mode="mirror") > NEARLY_BLACK
    gradient = np.hypot(correlate(gray, SCHARR, mode="mirror"), correlate(gray, SCHARR.T, mode="mirror")) * lit
    chosen = np.zeros(gray.shape, bool)
    for rows in np.array_split(np.arange(gray.shape[0]), BLOCKS):
        for columns in np.array_split(np.arange(gray.shape[1]), BLOCKS):
            block = gradient[(at := np.ix_(rows, columns))]
            chosen[at] = block > EDGE_FACTOR * np.median(block) if block.size else False
    return chosen


@dataclass(eq=False)
class Target:
    """What a view should render: color [3, rows, columns], depth [rows, columns] m (0 = no reading or padding);
    textured: the same with readings only where colour counts, None if it counts everywhere."""

    camera: Camera
    color: Tensor
    depth: Tensor
    valid_pixels: int
    textured: "Target | None" = None
    _on_device: "Target | None" = dataclass_field(default=None, init=False, repr=False)

    def to(self, device: torch.device) -> "Target":
        """Return the target on a device; the latest copy is cached."""
        if self.depth.device == device:
            return self
        if self._on_device is None or self._on_device.depth.device != device:
            color, depth = self.color.to(device), self.depth.to(device)
            on_texture = None if self.textured is None else self.textured.to(device)
            self._on_device = Target(self.camera, color, depth, self.valid_pixels, on_texture)
        return self._on_device

    @staticmethod
    def of(frame: Frame, size: tuple[int, int]) -> "Target":
        """Make the target of a frame on planes of `size` = (rows, columns), at least the frame's size."""
        color, depth = torch.empty(3, *size), torch.empty(size)
        readings = _core.image_planes(frame.color, frame.depth_m, color.numpy(), depth.numpy())
        return Target(frame.camera, color, depth, readings)

    @property
    def image(self) -> Tensor:
        """Return the colour as [H, W, 3]."""
        return self.color[:, : self.camera.height, : self.camera.width].movedim(0, -1)

    @property
    def depth_image(self) -> Tensor:
        """Return the depth as [H, W], metres."""
        return self.depth[: self.camera.height, : self.camera.width]

    def with_depth(self, depth_m: NDArray[np.float32]) -> "Target":
        """Return the same colour with other depth [H, W], m."""
        depth = torch.zeros_like(self.depth)
        depth[: self.camera.height, : self.camera.width] = torch.from_numpy(depth_m)
        return Target(self.camera, self.color, depth, int((depth_m > 0).sum()))

    def only_textured(self) -> "Target":
        """Return the same images, of which colour counts only where it has texture (`textured`)."""
        chosen = textured(self.image.numpy())
        return replace(self, textured=self.with_depth(self.depth_image.numpy() * chosen))

    def read_at_once(self, readout: Readout) -> "Target":
        """Return the images as the camera sees them at one time (`data.readout`)."""
        frame = Frame(0, 0.0, self.image.numpy(), self.depth_image.numpy(), self.camera)
        rows, columns = self.depth.shape
        return Target.of(read_at_once(frame, readout), (rows, columns))

    def without_exposure(self, exposure: NDArray[np.float64]) -> "Target":
        """Return the same depth with the colours in the exposure of the map (`data.camera`), in [0, 1]."""
        gain, offset = torch.from_numpy(exposure).float().T[..., None, None]
        color, inside = torch.zeros_like(self.color), np.s_[:, : self.camera.height, : self.camera.width]
        color[inside] = ((self.color[inside] - offset) / gain).clamp_(0.0, 1.0)
        return Target(self.camera, color, self.depth, self.valid_pixels)

    def picture(self) -> Picture:
        """Return the image; colour is rounded to 256 steps, as a camera delivers it."""
        color = (self.image.numpy() * 255.0).round().clip(0, 255).astype(np.uint8)
        return Picture(np.ascontiguousarray(color), self.depth_image.numpy().copy())

    @staticmethod
    def of_picture(picture: Picture, camera: Camera, size: tuple[int, int]) -> "Target":
        """Make the target of an earlier keyframe's picture."""
        return Target.of(Frame(0, 0.0, picture.unit_color, picture.depth_m, camera), size)


@dataclass(eq=False)
class Keyframe:
    """A target with its camera pose T_world_camera, float64 [4, 4].

    A `fixed` pose never moves. A fit moves the other poses if they are `movable`, which is set before the fit;
    pose_rate: factor on the learning rates of its pose.
    """

    index: int
    target: Target
    T_world_camera: NDArray[np.float64]
    fixed: bool = False
    movable: bool = True
    pose_rate: float = 1.0
    motion: VectorAdam = dataclass_field(default_factory=lambda: VectorAdam.of(6))
    visible_ids: NDArray[np.int64] | None = None
    """Sorted ids of the splats that dominate at least one of its pixels; None if not computed."""
    descriptor: NDArray[np.float32] | None = None
    detail: Detail | None = None
    """The gray image in which features are found."""
    photo: Photo | None = None
    """The colour at the camera's own size, for the final map."""

    def picture(self) -> Picture:
        """Return the images that a finished submap keeps of it."""
        return replace(self.target.picture(), detail=self.detail, photo=self.photo)

    def move(self, gradient: NDArray[np.float64], rates: NDArray[np.float64]) -> None:
        """Take an Adam step on the pose; gradient [6] by the left twist of T_camera_world, rates [6] in m and rad."""
        update = self.motion.step(gradient, self.pose_rate * rates)
        self.T_world_camera = se3.orthonormalise(self.T_world_camera @ se3.exp(-update))
