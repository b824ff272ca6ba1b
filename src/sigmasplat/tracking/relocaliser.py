"""Find a lost camera in the whole map: retrieve keyframes by features, compute a pose, align, verify the surface.

Many cheap candidates come first, then a minimal solver, dense alignment, and acceptance by depth and overlap. A pose is
never accepted by its number of inliers alone, because a repeated pattern has many.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.relative_pose import RelativePose
from sigmasplat.data.submap import KeyframeId, Picture, SubmapStore
from sigmasplat.fit.compare import Comparison
from sigmasplat.fit.pose import PoseFit, fit_pose_align
from sigmasplat.fit.references import Reference, map_reference, picture_images
from sigmasplat.fit.target import Keyframe
from sigmasplat.render.view import View
from sigmasplat.tracking.drift import UNKNOWN, floor, symmetric
from sigmasplat.tracking.feature_image import FeatureImage, pose_by_features
from sigmasplat.tracking.features import LEAST_INLIERS, VOTE_RATIO, Extractor, Features, Landmarks, matched_by_distance
from sigmasplat.tracking.pose_validation import MOST_SPREAD_M, p_wrong, recognised
from sigmasplat.tracking.prepared_frame import PreparedFrame, TrackedKeyframe
from sigmasplat.types import Matrix, Task, at_once


@dataclass(frozen=True, eq=False)
class KnownMap:
    """Finished submaps in a store, and the active one by its keyframes and splats.

    keyframe_poses: T_submap_camera [4, 4] of the keyframes of each submap (`Atlas.keyframe_poses`); wanted: whether a
    submap is searched.
    """

    store: SubmapStore
    keyframe_poses: Sequence[Sequence[Matrix]]
    active: Sequence[Keyframe]
    field: GaussianField
    wanted: Callable[[int], bool] = lambda submap: True

    def keyframes(self) -> list[KeyframeId]:
        """Return all keyframes to search, the newest first."""
        found = [(s, k) for s, poses in enumerate(self.keyframe_poses) if self.wanted(s) for k in range(len(poses))]
        return found[::-1]

    def picture(self, where: KeyframeId) -> Picture:
        """Return the images of a keyframe."""
        submap, k = where
        return self.store.picture(submap, k) if submap < len(self.store) else self.active[k].picture()

    def T_submap_camera(self, where: KeyframeId) -> Matrix:
        """Return the pose [4, 4] of a keyframe."""
        return self.keyframe_poses[where[0]][where[1]]

    def splats(self, submap: int) -> GaussianField:
        """Return the splats of a submap, in its frame."""
        return self.store.load(submap).field if submap < len(self.store) else self.field


STRONGEST = 400
"""Number of features of each image that are compared to choose candidates."""
INDEX_AT_MOST = 25
"""Maximum number of keyframes whose features are found per call: 25 take about a second."""
KEPT_LANDMARKS = 64
"""Number of keyframes whose complete landmarks stay in memory, half a megabyte each."""


@dataclass(frozen=True, eq=False)
class Relocation:
    """Where the camera was found: submap and keyframe by number, the keyframe, the number of matches that support the
    pose, the fit whose T_camera_world is T_camera_submap [4, 4], and its comparison with the map."""

    where: KeyframeId
    keyframe: TrackedKeyframe
    inliers: int
    fit: PoseFit
    comparison: Comparison
    scene_scale: float = 1.0

    @property
    def T_submap_camera(self) -> Matrix:
        """Return the pose [4, 4] of the camera in the submap."""
        return se3.inverse(self.fit.T_camera_world)

    @property
    def _estimated(self) -> Matrix:
        estimated = self.fit.covariance
        return UNKNOWN if estimated is None or not np.isfinite(estimated).all() else estimated

    @property
    def covariance(self) -> Matrix:
        """Return the covariance [6, 6] of the camera's translation and rotation in its own axes, m and rad."""
        return self._estimated + floor(self.scene_scale)

    @property
    def position_m(self) -> float:
        """Return the standard deviation of the position, metres."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def information(self) -> Matrix:
        """Return the information [6, 6] of T_submap_camera's left twist, m and rad."""
        A = se3.adjoint(self.T_submap_camera)
        covariance = A @ self._estimated @ A.T + floor(self.scene_scale)
        return symmetric(np.asarray(np.linalg.inv(symmetric(covariance)), np.float64))

    def relative_pose(self, submap: int) -> RelativePose:
        """Return where a submap begins that starts at this camera."""
        return RelativePose(self.where[0], submap, self.T_submap_camera, self.information, "relocalisation")


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Where the camera was found, if the map confirms it; the number of similar keyframes; the best refused pose."""

    found: Relocation | None
    candidates: int
    refused: Relocation | None


@dataclass(eq=False)
class Relocaliser:
    """Searches a map for the camera. The features of keyframes are found when they are first needed.

    indexed: the keyframes that are searched, in the order in which they were added.
    """

    config: Config
    extractor: Extractor | None
    indexed: list[KeyframeId] = field(default_factory=list)
    _strongest: dict[KeyframeId, Features] = field(default_factory=dict, init=False)
    _landmarks: "OrderedDict[KeyframeId, Landmarks]" = field(default_factory=OrderedDict, init=False)

    def searching(
        self, known: KnownMap, view: View, seen: PreparedFrame, index_at_most: int | None = INDEX_AT_MOST
    ) -> Task[SearchResult]:
        """Return where the camera is, if a keyframe leads to a pose that the map confirms, and what was refused, in
        slices: the features of one keyframe, one pose. `known` must not change.

        index_at_most: number of keyframes that may be added to the search; None = all.
        """
        wanted = known.keyframes()
        yield from self._index(known, view, wanted, index_at_most)
        candidates = self._candidates(wanted, seen)
        best: dict[bool, Relocation] = {}
        for tried in (pose for where in candidates for pose in self._poses(known, view, seen, where)):
            spread_m = MOST_SPREAD_M * view.options.scene_scale
            verdict = recognised(tried.comparison, tried.inliers) and tried.position_m <= spread_m
            if verdict not in best or p_wrong(tried.comparison) < p_wrong(best[verdict].comparison):
                best[verdict] = tried
            if verdict and recognised(tried.comparison, matches=0):  # as sure as without features
                break
            yield
        return SearchResult(best.get(True), len(candidates), best.get(False))

    search = at_once(searching)
    """Search as `searching` does, in one go."""

    def _index(self, known: KnownMap, view: View, wanted: Sequence[KeyframeId], at_most: int | None) -> Task[None]:
        """Add keyframes to the search, and find the features that are missing, also those of a resumed run."""
        have = set(self.indexed)
        self.indexed += [where for where in wanted if where not in have][:at_most]
        for where in self.indexed:
            if where not in self._strongest:
                self._landmarks_of(known, view, where)
                yield

    def _landmarks_of(self, known: KnownMap, view: View, where: KeyframeId) -> Landmarks:
        """Return the landmarks of a keyframe; those used last stay in memory."""
        if where not in self._landmarks:
            assert self.extractor is not None
            landmarks = FeatureImage.of_picture(known.picture(where), view.camera).landmarks(self.extractor)
            self._landmarks[where] = landmarks
            some = landmarks.features.take(np.arange(min(STRONGEST, len(landmarks))))
            if some.descriptors.dtype == np.float32:  # half precision holds them exactly
                some = replace(some, descriptors=some.descriptors.astype(np.float16))
            self._strongest[where] = some
            if len(self._landmarks) > KEPT_LANDMARKS:
                self._landmarks.popitem(last=False)
        self._landmarks.move_to_end(where)
        return self._landmarks[where]

    def _candidates(self, wanted: Sequence[KeyframeId], seen: PreparedFrame) -> list[KeyframeId]:
        """Return the keyframes with the most matches, best first."""
        assert seen.image is not None and self.extractor is not None
        live = seen.image.features(self.extractor)
        live, searched = live.take(np.arange(min(STRONGEST, len(live)))), set(self.indexed)
        votes = [
            (len(matched_by_distance(self._strongest[where].descriptors, live.descriptors, VOTE_RATIO)), where)
            for where in wanted
            if where in searched
        ]
        best = sorted((vote for vote in votes if vote[0] >= LEAST_INLIERS), key=lambda vote: -vote[0])
        return [where for _, where in best[: self.config.recovery.candidates]]

    def _poses(self, known: KnownMap, view: View, seen: PreparedFrame, where: KeyframeId) -> Iterator[Relocation]:
        """Yield the pose of a candidate, aligned to the keyframe's own image, then to the map rendered there."""
        assert seen.image is not None and self.extractor is not None
        picture, landmarks = known.picture(where), self._landmarks_of(known, view, where)
        found = pose_by_features(landmarks, seen.image, self.extractor, seed=self.config.seed)
        if found is None:
            return
        T_keyframe_submap, c = se3.inverse(known.T_submap_camera(where)), self.config.tracking
        guess = found.T_live_reference @ T_keyframe_submap
        own = Reference(picture_images(view, picture, view.camera)[1], T_keyframe_submap, where[1])
        keyframe = TrackedKeyframe(own, FeatureImage.of_picture(picture, view.camera))
        params = known.splats(where[0]).params.to(view.sums.device)
        for reference in (own, None):
            reference = reference or map_reference(params, view, guess, c)
            fit = fit_pose_align(reference, seen.live, guess, c)
            compared = fit.comparison or reference.compared(seen.live, fit.T_camera_world)
            yield Relocation(where, keyframe, found.inliers, fit, compared, view.options.scene_scale)
