"""Find features in the image of a frame: gray at its own size, depth at working size."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.data.frame import Detail, Frame
from sigmasplat.data.submap import Picture
from sigmasplat.env import opencv
from sigmasplat.tracking.features import Extractor, Features, Landmarks, PnP, landmarks_of, pose_from_landmarks, reduced


def detail_of(frame: Frame) -> Detail:
    """Return the gray image of a frame at its own size, or `FEATURE_WIDTH` pixels wide if it is wider."""
    return Detail(*reduced(gray_levels(frame.color), frame.camera))


def gray_levels(color: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the gray values [H, W], 0 to 255, of colour [H, W, 3] in [0, 1]."""
    cv2 = opencv()
    gray: NDArray[np.uint8] = cv2.convertScaleAbs(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), alpha=255.0)
    return gray


class LateDetail:
    """The gray image of a frame, computed when it is first needed: most frames do not need it."""

    def __init__(self, frame: Frame) -> None:
        self._frame: Frame | None = frame
        self._detail: Detail | None = None

    def get(self) -> Detail:
        """Return the gray image. Threads may share this object."""
        frame = self._frame
        if frame is not None:
            self._detail = detail_of(frame)
            self._frame = None
        assert self._detail is not None  # it is set before the frame is dropped
        return self._detail


class DetailField:
    """The field of a dataclass that is given as a `Detail` or as a `LateDetail`, and read as a `Detail`."""

    def __get__(self, owner: Any, _: type) -> Detail:
        if owner is None:
            raise AttributeError("the field has no default")
        given = owner.given_detail
        return given.get() if isinstance(given, LateDetail) else given

    def __set__(self, owner: Any, given: Detail | LateDetail) -> None:
        owner.given_detail = given


@dataclass(eq=False)
class FeatureImage:
    """The gray image of a frame at its own size, and its depth [h, w] (m, 0 = no reading) in the working camera.
    Features are found when they are first needed, and kept."""

    detail: DetailField = DetailField()
    depth_m: NDArray[np.float32]  # type: ignore[misc]  # mypy takes the descriptor above for a default
    camera: Camera  # type: ignore[misc]
    given_detail: Detail | LateDetail = field(init=False, repr=False)
    _features: Features | None = field(default=None, init=False, repr=False)
    _landmarks: Landmarks | None = field(default=None, init=False, repr=False)

    @staticmethod
    def of_picture(picture: Picture, camera: Camera) -> "FeatureImage":
        """Return the image in which the features of a keyframe are found; camera: of the working images."""
        detail = picture.detail or Detail(gray_levels(picture.unit_color), camera)
        return FeatureImage(detail, picture.depth_m, camera)

    def features(self, extractor: Extractor) -> Features:
        """Return the features of the image."""
        if self._features is None:
            self._features = extractor.find(self.detail.gray, self.detail.camera)
        return self._features

    def with_depth(self, depth_m: NDArray[np.float32]) -> "FeatureImage":
        """Return the same image with other depth [h, w], m; features that were found already are kept."""
        other = FeatureImage(self.given_detail, depth_m, self.camera)
        other._features = self._features
        return other

    def landmarks(self, extractor: Extractor) -> Landmarks:
        """Return the features that have depth."""
        if self._landmarks is None:
            self._landmarks = landmarks_of(self.features(extractor), self.depth_m, self.camera)
        return self._landmarks


def pose_by_features(reference: Landmarks, live: FeatureImage, extractor: Extractor, seed: int) -> PnP | None:
    """Match landmarks with the features of a live image; return the pose, or None if the matches do not give one."""
    seen = live.features(extractor)
    return pose_from_landmarks(reference, seen, extractor.match(reference.features, seen), seed)
