"""Find and match RootSIFT and ORB features with OpenCV."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import FeatureConfig
from sigmasplat.data.camera import Camera
from sigmasplat.env import opencv
from sigmasplat.tracking.features.base import Features, Gray, Pairs, matched_by_distance, no_features, reduced, rounded

SIFT_CONTRAST = 0.02
"""Half of OpenCV's contrast threshold: indoor walls have weak texture."""
ORB_SCALE = 1.2
ORB_BITS_MOST = 64
"""ORB matches with more than this many different bits of 256 are refused."""


class Sift:
    """RootSIFT (Lowe 2004; Arandjelović & Zisserman 2012), matched by mutual nearest neighbours and ratio."""

    def __init__(self, config: FeatureConfig) -> None:
        self.config = config
        # The precise upscale puts pixel centres at integers; without it all points are shifted by ¼ pixel.
        self._sift = opencv().SIFT_create(
            nfeatures=config.count, contrastThreshold=SIFT_CONTRAST, enable_precise_upscale=True
        )

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features; sigma_px grows with the scale of the feature."""
        gray, camera = reduced(gray, camera, self.config.width)
        keypoints, raw = self._sift.detectAndCompute(gray, None)
        if not keypoints:
            return no_features(camera, np.zeros((0, 128), np.float32))
        rows, points, diameter, _ = _strongest(keypoints, self.config.count)
        raw = raw[rows]
        root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-9))
        # A keypoint's diameter is twice the standard deviation of its Gaussian.
        return Features(points, 0.5 + 0.1 * diameter, rounded(root), camera)

    def match(self, a: Features, b: Features) -> Pairs:
        """Return mutual nearest neighbours that pass the ratio test."""
        return matched_by_distance(a.descriptors, b.descriptors, self.config.ratio)


class Orb:
    """ORB (Rublee et al. 2011), matched by mutual nearest neighbours in Hamming distance and ratio."""

    def __init__(self, config: FeatureConfig) -> None:
        self.config = config
        self._orb = opencv().ORB_create(nfeatures=config.count, scaleFactor=ORB_SCALE, fastThreshold=10)
        self._matcher = opencv().BFMatcher(opencv().NORM_HAMMING)

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features; sigma_px is one pixel of the pyramid level."""
        gray, camera = reduced(gray, camera, self.config.width)
        keypoints, raw = self._orb.detectAndCompute(gray, None)
        if not keypoints:
            return no_features(camera, np.zeros((0, 32), np.uint8))
        rows, points, _, octave = _strongest(keypoints, self.config.count)
        scale = (ORB_SCALE**octave).astype(np.float32)
        # OpenCV multiplies level coordinates by the scale, which maps pixel corners, not centres.
        return Features(points + (0.5 * scale - 0.5)[:, None], 0.7 * scale, raw[rows], camera)

    def match(self, a: Features, b: Features) -> Pairs:
        """Return mutual nearest neighbours that pass the ratio test."""
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.intp)
        forward = self._matcher.knnMatch(a.descriptors, b.descriptors, k=2)
        best = np.array([row[0].trainIdx for row in forward], np.intp)
        distance = np.array([[hit.distance for hit in row] for row in forward])
        back = np.array([hit.trainIdx for hit in self._matcher.match(b.descriptors, a.descriptors)], np.intp)
        rows = np.arange(len(a))
        good = (back[best] == rows) & (distance[:, 0] < self.config.ratio * distance[:, 1])
        good &= distance[:, 0] <= ORB_BITS_MOST
        return np.asarray(np.stack([rows, best], 1)[good])


def _strongest(
    keypoints: Any, count: int
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """Return the order of keypoints, strongest first and ties by position, with points, diameters and octaves in that
    order."""
    values = np.array([(*p.pt, p.response, p.size, p.angle, p.octave) for p in keypoints], np.float64)
    order = np.lexsort((values[:, 4], values[:, 3], values[:, 0], values[:, 1], -values[:, 2]))[:count]
    values = values[order]
    return order, values[:, :2].astype(np.float32), values[:, 3].astype(np.float32), values[:, 5].astype(np.int64)
