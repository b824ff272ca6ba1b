"""Sparse features (RootSIFT of OpenCV), their matches, and landmarks: features with depth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv
from sigmasplat.types import Matrix

Gray = NDArray[np.uint8]
Pairs = NDArray[np.intp]

COUNT = 1200
"""Maximum number of features per image; the strongest are used. More features find more poses and take more time."""
FEATURE_WIDTH = 640
"""Images wider than this are reduced to this width before detection."""
CONTRAST = 0.02
"""Half of OpenCV's contrast threshold: indoor walls have weak texture."""
RATIO, VOTE_RATIO = 0.9, 0.85
"""A match is used if its descriptor distance is below this multiple of the distance to the second-best candidate (Lowe
2004); it counts as a vote for a keyframe below the second one."""
DESCRIPTOR_STEP = 1.0 / 512.0
"""Float descriptors are multiples of this. Their products and sums are then exact in float32, so that matches do not
depend on the order of summation, hence not on the number of threads."""


@dataclass(frozen=True, eq=False)
class Features:
    """The features of one image, strongest first.

    points [N, 2]: pixels (u, v), centres at integers; sigma_px [N]: standard deviation of a point per axis;
    descriptors: [N, D] float32 of about unit norm, multiples of `DESCRIPTOR_STEP`; camera: the pinhole of the image in
    which they were found. It is smaller than the frame's if the image was reduced.
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


class Extractor:
    """RootSIFT (Lowe 2004; Arandjelović & Zisserman 2012), matched by mutual nearest neighbours and ratio."""

    def __init__(self) -> None:
        # The precise upscale puts pixel centres at integers; without it all points are shifted by ¼ pixel.
        self._sift = opencv().SIFT_create(nfeatures=COUNT, contrastThreshold=CONTRAST, enable_precise_upscale=True)

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features in an image [H, W]; camera is its pinhole. sigma_px grows with the scale of the feature."""
        gray, camera = reduced(gray, camera)
        keypoints, raw = self._sift.detectAndCompute(gray, None)
        if not keypoints:
            points, sigma_px, descriptors = (np.zeros(size, np.float32) for size in ((0, 2), 0, (0, 128)))
            return Features(points, sigma_px, descriptors, camera)
        values = np.array([(*p.pt, p.response, p.size, p.angle) for p in keypoints], np.float64)
        # strongest first, ties by position
        order = np.lexsort((values[:, 4], values[:, 3], values[:, 0], values[:, 1], -values[:, 2]))[:COUNT]
        raw, points, diameter = raw[order], values[order, :2].astype(np.float32), values[order, 3].astype(np.float32)
        root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9))
        descriptors = np.asarray(np.rint(root / DESCRIPTOR_STEP) * DESCRIPTOR_STEP, np.float32)
        # A keypoint's diameter is twice the standard deviation of its Gaussian.
        return Features(points, 0.5 + 0.1 * diameter, descriptors, camera)

    def match(self, a: Features, b: Features) -> Pairs:
        """Return matches [M, 2]: rows of a and rows of b, each used at most once, ordered by row of a."""
        return matched_by_distance(a.descriptors, b.descriptors, RATIO)


def reduced(gray: Gray, camera: Camera) -> tuple[Gray, Camera]:
    """Return the image and its camera at most `FEATURE_WIDTH` pixels wide."""
    if camera.width <= FEATURE_WIDTH:
        return np.ascontiguousarray(gray), camera
    small = camera.prepared(FEATURE_WIDTH)
    cv2 = opencv()
    return cv2.resize(gray, (small.width, small.height), interpolation=cv2.INTER_AREA), small


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


NOISE_RELATIVE_PER_M = 0.003
"""Standard deviation of a depth reading, times z² (m), as in `fit.align` (Khoshelham & Elberink 2012)."""
STEP_SHARE = 0.03
"""A reading is at a depth step if the 3×3 readings around it differ by more than this share of the depth."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Features with a position in space, in the frame of the camera that saw them.

    points_m [N, 3]; sigma_m [N]: standard deviation of the depth; weight [N]: factor on the information of a landmark,
    0 to 1.
    """

    features: Features
    points_m: Matrix
    sigma_m: Matrix
    weight: Matrix

    def __len__(self) -> int:
        return len(self.features)


def landmarks_of(
    features: Features, depth_m: NDArray[np.float32], depth_camera: Camera, weights: NDArray[np.floating] | None = None
) -> Landmarks:
    """Return the features that have a depth reading away from depth steps, with their positions.

    depth_m [h, w] and weights [h, w] (all 1 if None) are images of `depth_camera`, which may have another size and
    crop than the camera of the features, but the same pose.
    """
    z = depth_readings(features, depth_m, depth_camera)
    kept = z > 0
    some, z = features.take(kept), z[kept]
    c = some.camera
    u, v = some.points.T.astype(np.float64)
    points = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], 1)
    column, row, _ = _pixels(some, depth_camera)
    weight = np.ones(len(z)) if weights is None else np.asarray(weights[row, column], np.float64)
    return Landmarks(some, points, depth_sigma_m(z), weight)


def depth_readings(features: Features, depth_m: NDArray[np.float32], depth_camera: Camera) -> Matrix:
    """Return the depth of each feature [N], metres: the reading of the nearest pixel; 0 = no reading, or a depth
    step."""
    column, row, inside = _pixels(features, depth_camera)
    padded = np.pad(np.asarray(depth_m, np.float64), 1)
    around = np.stack([padded[row + i, column + k] for i in range(3) for k in range(3)])
    z = around[4]
    low = np.where(around > 0, around, np.inf).min(0)
    smooth = around.max(0) - low <= STEP_SHARE * z
    return np.where(inside & (z > 0) & smooth, z, 0.0)


def depth_sigma_m(z: Matrix) -> Matrix:
    """Return the standard deviation of depth readings, metres."""
    return NOISE_RELATIVE_PER_M * z * z + 1e-3


def _pixels(features: Features, camera: Camera) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Return column and row of the nearest pixel of `camera` for each feature, clipped to the image, and whether it is
    inside."""
    c = features.camera
    u, v = features.points.T.astype(np.float64)
    column = np.rint((u - c.cx) / c.fx * camera.fx + camera.cx).astype(np.intp)
    row = np.rint((v - c.cy) / c.fy * camera.fy + camera.cy).astype(np.intp)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return column.clip(0, camera.width - 1), row.clip(0, camera.height - 1), inside
