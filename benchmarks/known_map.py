"""Search for a camera in a map of keyframes with true poses, by the relocalisation of SLAM: for relocalisation.py."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tracking import relative_error

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.submap import MemoryStore, Picture, Submap
from sigmasplat.fit.references import live_image
from sigmasplat.fit.target import Target
from sigmasplat.input.source import Source
from sigmasplat.render.backend import make_view
from sigmasplat.tracking.feature_image import FeatureImage, detail_of
from sigmasplat.tracking.features import Extractor
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.relocaliser import KnownMap, Relocaliser

Matrix = NDArray[np.float64]
EVERY, APART = 5, 40
"""Every fifth frame is a keyframe of the map; those at most this many frames from the searched frame are left out."""


class TrueMap:
    """Keyframes with their images and true poses. Each is a submap of its own without splats, so that each can be left
    out of a search."""

    def __init__(self, source: Source, poses: Matrix, config: Config) -> None:
        self.source, self.poses, self.config = source, poses, config
        self.extractor = Extractor()
        self.relocaliser = Relocaliser(self.config, self.extractor)
        self.view = make_view(config.backend, self._working(source.frame(0)).camera, config.render)
        self.keyframes = list(range(0, len(poses), EVERY))
        self.store = MemoryStore()
        for number, i in enumerate(self.keyframes):
            frame = source.frame(i)
            small = self._working(frame)
            color = np.rint(small.color * 255.0).astype(np.uint8)
            picture = Picture(color, small.depth_m, detail_of(frame))
            self.store.save(Submap(number, GaussianField.empty(), (i,), np.eye(4)[None], small.camera), [picture])

    def search(self, i: int) -> dict[str, Any]:
        """Search for frame i; return whether it was found, and the error of its pose."""
        known = KnownMap(
            self.store,
            [[np.eye(4)]] * len(self.keyframes),
            [],
            GaussianField.empty(),
            wanted=lambda submap: abs(self.keyframes[submap] - i) > APART,
        )
        seen = self._sight(self.source.frame(i))
        assert seen.image is not None
        seen.image.features(self.extractor)
        clock = time.process_time()
        found = self.relocaliser.search(known, self.view, seen, index_at_most=None).found
        searched: dict[str, Any] = {"frame": i, "cpu_ms": round(1e3 * (time.process_time() - clock), 1)}
        if found is None:
            return searched | {"found": False}
        k = self.keyframes[found.where[0]]
        true = se3.inverse(self.poses[k]) @ self.poses[i]
        error = relative_error(found.T_submap_camera, true)
        return searched | {"found": True, "keyframe": k, "inliers": found.inliers} | error

    def _working(self, frame: Frame) -> Frame:
        i = self.config.input
        return frame.prepared(i.width, i.min_depth_m, i.max_depth_m, i.crop_px)

    def _sight(self, frame: Frame) -> PreparedFrame:
        """Return a frame in the forms that the search needs."""
        small = self._working(frame)
        target = Target.of(small, (self.view.sums.shape[1], self.view.sums.shape[2]))
        image = FeatureImage(detail_of(frame), small.depth_m, small.camera)
        live = live_image(self.view, small.color, small.depth_m, target)
        return PreparedFrame(target, live, image, frame=small, whole=frame)
