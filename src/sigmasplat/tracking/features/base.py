"""Define features and what an extractor of features can do."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import FeatureConfig
from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv

Gray = NDArray[np.uint8]
Pairs = NDArray[np.intp]

DESCRIPTOR_STEP = 1.0 / 512.0
"""Float descriptors are multiples of this. Their products and sums are then exact in float32, so that matches do not
depend on the order of summation, hence not on the number of threads."""


@dataclass(frozen=True, eq=False)
class Features:
    """The features of one image, strongest first.

    points [N, 2]: pixels (u, v), centres at integers; sigma_px [N]: standard deviation of a point per axis;
    descriptors: [N, D] float32 of about unit norm, multiples of `DESCRIPTOR_STEP` (sift, xfeat), or [N, 32] uint8
    (orb); camera: the pinhole of the image in which they were found. It is smaller than the frame's if the image was
    reduced.
    """

    points: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    descriptors: NDArray[Any]
    camera: Camera

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: NDArray[Any]) -> "Features":
        """Return the features of some rows (indices or a mask)."""
        return Features(self.points[rows], self.sigma_px[rows], self.descriptors[rows], self.camera)


class Extractor(Protocol):
    """One kind of features: finds them in an image and matches those of two images."""

    config: FeatureConfig

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features in an image [H, W]; camera is its pinhole."""
        ...

    def match(self, a: Features, b: Features) -> Pairs:
        """Return matches [M, 2]: rows of a and rows of b, each used at most once, ordered by row of a."""
        ...


def reduced(gray: Gray, camera: Camera, width: int) -> tuple[Gray, Camera]:
    """Return the image and its camera at most `width` pixels wide; 0 = unchanged."""
    if not width or camera.width <= width:
        return np.ascontiguousarray(gray), camera
    small = camera.prepared(width)
    cv2 = opencv()
    return cv2.resize(gray, (small.width, small.height), interpolation=cv2.INTER_AREA), small


def rounded(descriptors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return descriptors of unit norm as float32 multiples of `DESCRIPTOR_STEP`."""
    return np.asarray(np.rint(descriptors / DESCRIPTOR_STEP) * DESCRIPTOR_STEP, np.float32)


def no_features(camera: Camera, descriptors: NDArray[Any]) -> Features:
    """Return the features of an image in which none was found; descriptors [0, D] gives their form."""
    return Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), descriptors, camera)


def matched_by_distance(a: NDArray[np.float32], b: NDArray[np.float32], ratio: float) -> Pairs:
    """Return mutual nearest neighbours [M, 2] of descriptors a [N, D] and b [K, D] whose distance is below ratio × the
    distance to the second-best in b."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.intp)
    rows = np.arange(len(a))
    closeness = a @ b.T
    closeness *= 2.0
    closeness -= (b * b).sum(1)
    best, norm = closeness.argmax(1), (a * a).sum(1)
    nearest = norm - closeness[rows, best]
    back = (closeness - norm[:, None]).argmax(0)
    closeness[rows, best] = -np.inf
    second = norm - closeness.max(1)
    good = (back[best] == rows) & (nearest < ratio**2 * second)
    return np.asarray(np.stack([rows, best], 1)[good])
