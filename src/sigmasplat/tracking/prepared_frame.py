"""One frame, or one keyframe, in the forms that tracking and mapping need."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.config import Config, TrackingConfig
from sigmasplat.config.input import sensor_model
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera, gray_exposure, unexposed
from sigmasplat.data.frame import Frame, Photo, photo_size
from sigmasplat.data.readout import AT_ONCE, Readout, SensorTimes, read_at_once
from sigmasplat.data.submap import Picture
from sigmasplat.errors import SourceError
from sigmasplat.fit.field import loss_weights
from sigmasplat.fit.losses import take
from sigmasplat.fit.pyramid import HIDDEN_M, Pyramid
from sigmasplat.fit.references import Reference, keyframe_reference, live_image, picture_images
from sigmasplat.fit.target import Target
from sigmasplat.render.backend import make_view
from sigmasplat.render.view import View
from sigmasplat.tracking.depth_filters import denoised
from sigmasplat.tracking.feature_image import FeatureImage, LateDetail
from sigmasplat.tracking.features import Extractor
from sigmasplat.tracking.moving.dynamic_mask import DynamicMask
from sigmasplat.tracking.predicted_depth_fit import smoothed
from sigmasplat.types import Matrix


@dataclass(eq=False)
class PreparedFrame:
    """A frame in the forms that tracking and mapping need: the target of the fits, its pyramid, the image for features,
    the pixels [H, W] that the user wants to be ignored, which have no depth, how its camera moves (as far as tracking
    knows), the working frame, and the whole one as it was read."""

    target: Target
    live: Pyramid
    image: FeatureImage | None = None
    ignored: NDArray[np.bool_] | None = None
    reading: Readout = AT_ONCE
    frame: Frame = field(kw_only=True)
    whole: Frame = field(kw_only=True)

    @staticmethod
    def of_picture(picture: Picture, view: View) -> "PreparedFrame":
        """Return a keyframe of the map in the form of a frame to be found."""
        target, live = picture_images(view, picture, view.camera)
        frame = Frame(0, 0.0, picture.unit_color, picture.depth_m, view.camera)
        return PreparedFrame(target, live, FeatureImage.of_picture(picture, view.camera), frame=frame, whole=frame)

    def move(self, rate: Matrix, times: SensorTimes) -> None:
        """Take note of the motion of the camera, a twist per second [6] in its axes, and of when the sensor reads."""
        self.reading = Readout(rate, self.frame.depth_late_s)
        self.live = self.live.read(times.read(self.reading))

    def at_once(self, view: View, photo: bool = True) -> "PreparedFrame":
        """Return the frame as if all rows had been read at once, as far as it is known when they were; photo: also the
        whole image."""
        readout = self.live.readout
        if readout is None:
            return self
        whole = read_at_once(self.whole, readout) if photo else self.whole
        frame = self.frame.with_depth(self.target.depth_image.numpy())  # predicted depth is fitted in the target alone
        found = observe(whole, read_at_once(frame, readout), view, None)
        return replace(found, image=self.image, live=found.live.noisier(self.live.noise_per_m / found.live.noise_per_m))

    @property
    def shown(self) -> "PreparedFrame":
        """Return the frame for fits of its pose, which do not use the pixels that are to be ignored."""
        return self if self.ignored is None else self.aside(None)

    def without(self, front: DynamicMask | None) -> "PreparedFrame":
        """Return the frame without depth where something is in front: it is neither mapped nor a reference there."""
        if front is None:
            return self
        return self.with_depth(np.where(front.hidden, np.float32(0.0), self.target.depth_image.numpy()))

    def with_depth(self, depth_m: NDArray[np.float32]) -> "PreparedFrame":
        """Return the frame with other depth [H, W], m."""
        return replace(self._read_as(depth_m), live=self.live.with_depth(depth_m))

    def aside(self, front: DynamicMask | None) -> "PreparedFrame":
        """Return the frame for fits of its pose, without depth and colour of what is in front or ignored."""
        depth_m = self.target.depth_image.numpy()
        unread = self if front is None else self._read_as(np.where(front.hidden, np.float32(0.0), depth_m))
        hidden_m = np.where(self._unused(front), np.float32(HIDDEN_M), depth_m)
        return replace(unread, live=self.live.with_depth(hidden_m))

    def hiding(self, front: DynamicMask) -> Pyramid:
        """Return the images for comparisons and quick fits without what is in front or ignored."""
        return self.live.hiding(self._unused(front))

    def _unused(self, front: DynamicMask | None) -> NDArray[np.bool_]:
        """Return the pixels [H, W] of what is in front or ignored; without both, a single False."""
        hidden = np.zeros((), np.bool_) if front is None else front.hidden
        return hidden if self.ignored is None else hidden | self.ignored

    def separate(self) -> "PreparedFrame":
        """Return the same frame with an own image for features, which are found and kept when they are first needed."""
        return replace(self, image=None if self.image is None else self.image.with_depth(self.image.depth_m))

    def without_exposure(self, exposure: tuple[float, float]) -> "PreparedFrame":
        """Return the frame with the exposure (a, b) of exp(a) · colour + b removed from its target and its photo."""
        gray = gray_exposure(*exposure)
        whole = replace(self.whole, color=unexposed(self.whole.color, gray))
        return replace(self, target=self.target.without_exposure(gray), whole=whole)

    def _read_as(self, depth_m: NDArray[np.float32]) -> "PreparedFrame":
        """Return the frame with other depth [H, W], m, for everything but fits of its pose."""
        image = None if self.image is None else self.image.with_depth(depth_m)
        return replace(self, target=self.target.with_depth(depth_m), image=image)

    def photo(self, config: Config) -> Photo | None:
        """Return the colour at the size of the final map's last stage; None if working images are as large, or no final
        map is refined."""
        size = photo_size(self.whole.camera, config.input.width, config.input.crop_px, config.final.width)
        return Photo.of(self.whole, *size) if size and config.final.iterations else None


def view_of(camera: Camera, config: Config) -> View:
    """Make the view for working images of a camera, with planes for σ² if the run learns it or weighs by it, and with
    the noise of readings if alignment uses it."""
    tracking, learned = config.tracking, take(loss_weights(config.mapping), "variance")
    read = tracking.uncertainty and tracking.align_depth_by == "V"
    view = make_view(config.backend, camera, config.render, variance=learned or read)
    view.sensor = sensor_model(config.input.sensor) if tracking.verify else None
    return view


def working_frame(frame: Frame, config: Config, camera: Camera | None = None) -> Frame:
    """Return a frame at working size, with depth denoised if the settings say so; if `camera` is given and differs, the
    frame is resampled to it."""
    i = config.input
    working = frame.prepared(i.width, i.min_depth_m, i.max_depth_m, i.crop_px)
    if camera is not None and working.camera != camera:
        working = frame.seen_by(camera).prepared(0, i.min_depth_m, i.max_depth_m)
    depth_m, r = working.depth_m, config.render
    if config.tracking.fit_depth:
        depth_m = smoothed(depth_m)
    elif i.denoise_depth:
        depth_m = denoised(depth_m, r.depth_noise_per_m, r.scene_scale)
    return working.with_depth(depth_m)


def observe(whole: Frame, working: Frame, view: View, extractor: Extractor | None) -> PreparedFrame:
    """Return a frame in the forms that tracking needs: features are found in the whole frame, everything else is made
    from the working frame."""
    ignored = whole.ignored_by(working.camera)
    if ignored is not None:
        working = replace(working, depth_m=np.where(ignored, np.float32(0.0), working.depth_m))
    target = Target.of(working, (view.sums.shape[1], view.sums.shape[2]))
    live, image = live_image(view, working.color, working.depth_m, target), None
    if extractor is not None:
        image = FeatureImage(LateDetail(whole), working.depth_m, working.camera)
    return PreparedFrame(target, live, image, ignored, frame=working, whole=whole)


def refuse_first_without_depth(frame: Frame, config: Config) -> None:
    """Raise SourceError if the first frame of a map, at working size, has no depth."""
    if not (frame.depth_m > 0).any():
        raise SourceError(
            f"frame {frame.index} has no depth reading in [{config.input.min_depth_m}, {config.input.max_depth_m}] m "
            "to start a map from; check the depth scale, or start at a later one: --start SECONDS"
        )


@dataclass(frozen=True, eq=False)
class TrackedKeyframe:
    """What tracking keeps of a keyframe. The map's `Keyframe` has planes for the fits instead, and the state of Adam:
    neither needs the other's memory.

    reference: its image with the weights of the map; image: for features; front: what was in front of the scene."""

    reference: Reference
    image: FeatureImage | None
    front: DynamicMask | None = None

    def weighed(self, params: Tensor, view: View, config: TrackingConfig) -> "TrackedKeyframe":
        """Return a keyframe of the map at which the camera was found, weighed by the map with rows `params` [N, 17]."""
        own = self.reference
        weighed = keyframe_reference(params, view, own.pyramid, own.T_camera_world, config)
        return replace(self, reference=replace(weighed, keyframe=own.keyframe))


def mapped_keyframe(
    params: Tensor, view: View, seen: PreparedFrame, T_world_camera: Matrix, config: TrackingConfig,
    front: DynamicMask | None,
) -> TrackedKeyframe:  # fmt: skip
    """Return a keyframe that was just mapped, weighed by the map with rows `params` [N, 17]."""
    T_camera_world = se3.inverse(T_world_camera)
    return TrackedKeyframe(keyframe_reference(params, view, seen.live, T_camera_world, config), seen.image, front)
