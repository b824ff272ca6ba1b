"""Sparse features (RootSIFT of OpenCV), their matches, and landmarks, which are features with depth; the pose from
matches by RANSAC with P3P."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import Config
from sigmasplat.data.camera import Camera
from sigmasplat.data.readout import SAME_SURFACE
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

    points [N, 2]: pixels (u, v), centres at integers; descriptors: [N, D] float32 of about unit norm, multiples of
    `DESCRIPTOR_STEP`; camera: the pinhole of the image in which they were found. It is smaller than the frame's if the
    image was reduced.
    """

    points: NDArray[np.float32]
    descriptors: NDArray[Any]
    camera: Camera

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: NDArray[Any]) -> "Features":
        """Return the features of some rows (indices or a mask)."""
        return Features(self.points[rows], self.descriptors[rows], self.camera)


class Extractor:
    """RootSIFT (Lowe 2004; Arandjelović & Zisserman 2012), matched by mutual nearest neighbours and ratio."""

    def __init__(self) -> None:
        # The precise upscale puts pixel centres at integers; without it all points are shifted by ¼ pixel.
        self._sift = opencv().SIFT_create(nfeatures=COUNT, contrastThreshold=CONTRAST, enable_precise_upscale=True)

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features in an image [H, W]; camera is its pinhole."""
        gray, camera = reduced(gray, camera)
        keypoints, raw = self._sift.detectAndCompute(gray, None)
        if not keypoints:
            return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), camera)
        values = np.array([(*p.pt, p.response, p.size, p.angle) for p in keypoints], np.float64)
        # strongest first, ties by position
        order = np.lexsort((values[:, 4], values[:, 3], values[:, 0], values[:, 1], -values[:, 2]))[:COUNT]
        raw, points = raw[order], values[order, :2].astype(np.float32)
        root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9))
        descriptors = np.asarray(np.rint(root / DESCRIPTOR_STEP) * DESCRIPTOR_STEP, np.float32)
        return Features(points, descriptors, camera)

    def match(self, a: Features, b: Features) -> Pairs:
        """Return matches [M, 2]: rows of a and rows of b, each used at most once, ordered by row of a."""
        return matched_by_distance(a.descriptors, b.descriptors, RATIO)


def extractor_of(config: Config) -> Extractor | None:
    """Return the extractor of a run; None if nothing in it uses features."""
    return Extractor() if config.tracking.features or config.recovery.relocalise else None


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


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Features with a position in space, points_m [N, 3], in the frame of the camera that saw them."""

    features: Features
    points_m: Matrix

    def __len__(self) -> int:
        return len(self.features)


def landmarks_of(features: Features, depth_m: NDArray[np.float32], depth_camera: Camera) -> Landmarks:
    """Return the features that have a depth reading away from depth steps, with their positions.

    depth_m [h, w] is an image of `depth_camera`, which may have another size and crop than the camera of the features,
    but the same pose.
    """
    z = depth_readings(features, depth_m, depth_camera)
    kept = z > 0
    some, z = features.take(kept), z[kept]
    c = some.camera
    u, v = some.points.T.astype(np.float64)
    points = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z], 1)
    return Landmarks(some, points)


def depth_readings(features: Features, depth_m: NDArray[np.float32], depth_camera: Camera) -> Matrix:
    """Return the depth of each feature [N], m: the reading of the nearest pixel; 0 = no reading, or a depth step, where
    the 3×3 readings are not of one surface."""
    column, row, inside = nearest_pixels(features, depth_camera)
    padded = np.pad(np.asarray(depth_m, np.float64), 1)
    around = np.stack([padded[row + i, column + k] for i in range(3) for k in range(3)])
    z = around[4]
    low = np.where(around > 0, around, np.inf).min(0)
    smooth = around.max(0) - low <= SAME_SURFACE * z
    return np.where(inside & (z > 0) & smooth, z, 0.0)


def nearest_pixels(features: Features, camera: Camera) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Return column and row of the nearest pixel of `camera` for each feature, clipped to the image, and whether it is
    inside."""
    c = features.camera
    u, v = features.points.T.astype(np.float64)
    column = np.rint((u - c.cx) / c.fx * camera.fx + camera.cx).astype(np.intp)
    row = np.rint((v - c.cy) / c.fy * camera.fy + camera.cy).astype(np.intp)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    return column.clip(0, camera.width - 1), row.clip(0, camera.height - 1), inside


LEAST_INLIERS = 8
"""A pose needs so many matches: chance alone lets a few agree with the three that it was computed from."""
RANSAC_PX = 3.0
"""A match supports a pose if its reprojection error is below this, in pixels of an image of `FEATURE_WIDTH`; it scales
with the width."""
RANSAC_TRIES = 1000
"""Maximum number of minimal samples per pose. Fewer are drawn if a pose is found with `CONFIDENCE` sooner."""
CONFIDENCE = 0.999
NEAREST_M = 0.05


@dataclass(frozen=True, eq=False)
class PnP:
    """A pose from matches: T_live_reference [4, 4]; which matches support it [M]."""

    T_live_reference: Matrix
    supporting: NDArray[np.bool_]

    @property
    def inliers(self) -> int:
        """Return the number of supporting matches."""
        return int(self.supporting.sum())


def pose_from_landmarks(landmarks: Landmarks, features: Features, pairs: Pairs, seed: int) -> PnP | None:
    """Find the motion from the landmarks' camera to the features' camera; None with fewer than 8 inliers.

    pairs [M, 2]: rows of landmarks and features. The same input and seed give the same bits.
    """
    if len(pairs) < LEAST_INLIERS:
        return None
    points_m, seen = landmarks.points_m[pairs[:, 0]], features.points[pairs[:, 1]].astype(np.float64)
    gate_px = RANSAC_PX * features.camera.width / FEATURE_WIDTH
    T = _ransac(points_m, seen, features.camera, seed, gate_px)
    if T is None:
        return None
    supporting = _errors_px(points_m, seen, features.camera, T) < gate_px
    return PnP(T, supporting) if supporting.sum() >= LEAST_INLIERS else None


def _errors_px(points_m: Matrix, seen: Matrix, c: Camera, T: Matrix) -> Matrix:
    """Return the reprojection error of each match; infinite behind the camera."""
    x, y, z = T[:3, :3] @ points_m.T + T[:3, 3:]
    ahead = np.maximum(z, NEAREST_M)
    error = np.hypot(c.fx * x / ahead + c.cx - seen[:, 0], c.fy * y / ahead + c.cy - seen[:, 1])
    return np.where(z > NEAREST_M, error, np.inf)


def _ransac(points_m: Matrix, seen: Matrix, c: Camera, seed: int, gate_px: float) -> Matrix | None:
    """Return the pose that most matches support, from minimal samples (P3P) with local optimisation, or None."""
    cv2, order = opencv(), np.random.default_rng(seed).permutation(len(points_m))
    K = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
    params = cv2.UsacParams()
    params.randomGeneratorState = seed % 2**31
    params.isParallel = False
    params.maxIterations, params.threshold, params.confidence = RANSAC_TRIES, gate_px, CONFIDENCE
    try:
        found, _, rotation, shift, _ = cv2.solvePnPRansac(points_m[order], seen[order], K, None, params=params)
    except cv2.error:  # all samples are degenerate, such as points on one line
        return None
    if not found or rotation is None or not (np.isfinite(rotation).all() and np.isfinite(shift).all()):
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], shift.ravel()
    return T
