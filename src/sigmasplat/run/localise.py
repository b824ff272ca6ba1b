"""Find single images in the map of a finished run: pose, covariance, and a verdict with its reason."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.files.atomic import write_text
from sigmasplat.files.json_files import json_line
from sigmasplat.fit.compare import Comparison
from sigmasplat.graph.path_covariance import PathCovariance
from sigmasplat.run.finished_map import FinishedMap
from sigmasplat.run_folder.trajectory import write_trajectory
from sigmasplat.tracking.depth_filters import frame_filter
from sigmasplat.tracking.drift import symmetric
from sigmasplat.tracking.features import Extractor
from sigmasplat.tracking.prepared_frame import observe, view_of, working_frame
from sigmasplat.tracking.recovery import usable
from sigmasplat.tracking.relocaliser import KnownMap, Relocaliser, Relocation, SearchResult
from sigmasplat.types import Matrix

FOUND, APART, NOT_FOUND = "found", "apart", "not found"
"""Verdicts. Apart: found in a component of the map that is not connected to its world."""


@dataclass(frozen=True, eq=False)
class Localisation:
    """The result for one image.

    verdict: found, apart or not found; reason: why it was not found, else empty; T_world_camera [4, 4]: the pose in the
    frame of its component, None if not found; covariance [6, 6]: of translation and rotation (m, rad) in the axes of
    the camera, with the error of the map there; component, submap, keyframe: where it was found, −1 if nowhere;
    matches: number of features that support the pose; comparison: of the image with the map, at the pose or at the
    best refused one.
    """

    index: int
    timestamp_s: float
    verdict: str
    reason: str = ""
    T_world_camera: Matrix | None = None
    covariance: Matrix | None = None
    component: int = -1
    submap: int = -1
    keyframe: int = -1
    matches: int = 0
    comparison: Comparison | None = None

    @property
    def position_m(self) -> float:
        """Return the standard deviation of the position, metres; nan if the image was not found."""
        return float("nan") if self.covariance is None else float(np.sqrt(np.trace(self.covariance[:3, :3])))


class Localiser:
    """Finds images in the map of a finished run. The images may come from another camera with a similar view."""

    def __init__(self, finished: FinishedMap, config: Config) -> None:
        """Prepare the search. Raises ConfigError if OpenCV cannot be imported."""
        self.finished, self.config = finished, config
        self.filtered = frame_filter(config.input.filters)
        self.extractor = Extractor()
        self.view = view_of(finished.camera, config)
        self.relocaliser = Relocaliser(config, self.extractor)
        self.errors = PathCovariance.of(finished.run.read_checkpoint()[0])
        self.known = KnownMap(finished.store, finished.keyframe_poses, (), GaussianField.empty())

    def locate(self, frame: Frame) -> Localisation:
        """Return where an image was taken."""
        frame = self.filtered(frame)
        working = working_frame(frame, self.config, self.finished.camera)
        seen = observe(frame, working, self.view, self.extractor)
        if not usable(seen):
            return Localisation(frame.index, frame.timestamp_s, NOT_FOUND, "too little depth or texture")
        result = self.relocaliser.search(self.known, self.view, seen, index_at_most=None)
        if result.found is None:
            refused = None if result.refused is None else result.refused.comparison
            return Localisation(frame.index, frame.timestamp_s, NOT_FOUND, why_not(result), comparison=refused)
        return self._located(frame, result.found)

    def _located(self, frame: Frame, place: Relocation) -> Localisation:
        submap, keyframe = place.where
        component, T_world_submap = self.finished.components[submap], self.finished.anchors[submap]
        verdict, reason = (APART, f"in component {component}") if component else (FOUND, "")
        T_world_camera, covariance = T_world_submap @ place.T_submap_camera, place.covariance
        if self.errors is not None:
            A = se3.adjoint(se3.inverse(T_world_camera))
            covariance = symmetric(covariance + A @ self.errors.of_keyframe(submap, keyframe) @ A.T)
        return Localisation(
            frame.index, frame.timestamp_s, verdict, reason, T_world_camera, covariance, component, submap, keyframe,
            place.inliers, place.comparison,
        )  # fmt: skip


def why_not(result: SearchResult) -> str:
    """Return in words why a search found nothing."""
    if not result.candidates:
        return "no similar keyframe"
    if result.refused is None:
        return f"features match {result.candidates} keyframes, but give no pose"
    c = result.refused.comparison
    return (
        f"not confirmed by the map: {c.common:.0%} in common, {c.close:.0%} of it close, {c.behind:.0%} behind, "
        f"correlation {c.correlation:.2f}, {result.refused.inliers} matches, ± {100 * result.refused.position_m:.0f} cm"
    )


def write_localisations(path: Path, found: Sequence[Localisation]) -> None:
    """Write JSON lines (.jsonl, all images) or TUM text (.txt, the images found in the world).

    Raises RunError if it cannot be written.
    """
    if path.suffix == ".jsonl":
        write_text(path, "".join(json_line(asdict(result)) for result in found))
    else:
        write_trajectory(path, path_of(found))


def path_of(found: Iterable[Localisation]) -> Trajectory:
    """Return the poses of the images that were found in the world."""
    posed = [(r.timestamp_s, r.T_world_camera) for r in found if r.verdict == FOUND and r.T_world_camera is not None]
    return Trajectory(np.array([t for t, _ in posed]), np.array([T for _, T in posed]).reshape(-1, 4, 4))
