"""Register two submaps: keyframes of each are localised in the other, and the results must agree (VarSplat §5)."""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sigmasplat.config import Config, TrackingConfig
from sigmasplat.data import se3
from sigmasplat.data.submap import Picture, Submap, SubmapStore
from sigmasplat.fit.align import align
from sigmasplat.fit.compare import Comparison, compare
from sigmasplat.fit.pose import PoseFit, fit_pose_adam, fit_pose_align
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference, keyframe_reference, map_reference, picture_images
from sigmasplat.fit.target import Target
from sigmasplat.fit.tracking_loss import PoseMaps
from sigmasplat.graph.candidates import SubmapPair
from sigmasplat.graph.localisations import Localisation, combined, consensus, inverted, mean_covariance
from sigmasplat.render.view import View
from sigmasplat.tracking.drift import drift_to, symmetric, systematic_errors
from sigmasplat.tracking.feature_image import FeatureImage, pose_by_features
from sigmasplat.tracking.features import Extractor
from sigmasplat.tracking.pose_validation import confirmed
from sigmasplat.types import Matrix, Task, long_slice

HOPELESS = 0.5
"""If alignment explains less than this share of `share_least`, the keyframe is not refined further."""
DOUBTFUL = 0.6
"""If alignment from the known poses explains less than this share of a keyframe, features give another guess."""
OVERLAP_SAMPLE = 5000
OPAQUE = 0.95
"""Pixels count if the other submap's alpha is above this (VarSplat §5 uses it for depth; here for colour too)."""


@dataclass(frozen=True, eq=False)
class Registration:
    """T_a_b [4, 4] between submaps a and b, or the reason why the registration was refused.

    information [6, 6]: inverse covariance of T_a_b's left twist (m, rad); localised: the number of localisations that
    were used; residual: their mean loss; overlap: share of splats with a neighbour in the other submap; keyframes and
    drift: as in `RelativePose`.
    """

    T_a_b: Matrix
    information: Matrix
    residual: float
    localised: int
    overlap: float
    accepted: bool
    reason: str
    keyframes: tuple[int, int] = (0, 0)
    drift: Matrix = field(default_factory=lambda: np.zeros((6, 6)))


class Registrar:
    """Registers submaps of one store; all of them share the camera of the view. With an extractor, features give
    another guess where alignment from the known poses fits poorly, such as between wide angles. It remembers images of
    keyframes: make one for each search."""

    def __init__(self, config: Config, store: SubmapStore, view: View, extractor: Extractor | None = None) -> None:
        self.config, self.store, self.view, self.verify = config.registration, store, view, config.tracking.verify
        self.extractor, self.seed, self.tracking = extractor, config.seed, tracking_of(config)
        self._with_features: dict[tuple[int, int], FeatureImage] = {}
        self._images: dict[tuple[int, int], tuple[Target, Pyramid]] = {}
        self._references: dict[tuple[int, int], Reference] = {}

    def register(self, pair: SubmapPair, a: Submap, b: Submap, T_a_b: Matrix) -> Task[Registration]:
        """Register the submaps a (query) and b (database) of a pair, in slices of one alignment; T_a_b [4, 4] is the
        current estimate."""
        found = list[Localisation]()
        for k in pair.query_keyframes:
            found.append((yield from self._localise(a, k, b, pair.database_keyframes, T_a_b)))
        for k in pair.database_keyframes:
            found.append(inverted((yield from self._localise(b, k, a, pair.query_keyframes, se3.inverse(T_a_b)))))
        centre_b = b.T_submap_camera[pair.best.database_keyframe][:3, 3]
        return self._judge(a, b, found, centre_b, T_a_b)

    def _localise(
        self, own: Submap, keyframe: int, other: Submap, alike: Sequence[int], T_own_other: Matrix
    ) -> Task[Localisation]:
        """Localise a keyframe of `own` in `other`, in slices: align from the expected pose, and from those of similar
        keyframes and by features if that explains too little; then refine the best pose."""
        T_own_camera, other_rows = own.T_submap_camera[keyframe], other.field.params.to(self.view.sums.device)
        target, live = self._images_of(own, keyframe)
        fits = yield from self._all_aligned(other_rows, live, [se3.inverse(T_own_camera) @ T_own_other])
        if score(fits[0]) < DOUBTFUL:
            fits += yield from self._all_aligned(other_rows, live, map(se3.inverse, other.T_submap_camera[[*alike]]))
        if max(map(score, fits)) < DOUBTFUL:
            by_features = yield from self.guesses_by_features(own, keyframe, other, alike)
            fits += yield from self._all_aligned(other_rows, live, by_features)
        target = target.only_textured() if self.config.textured else target
        fit, at_keyframe = yield from self._refined(other, other_rows, target, live, max(fits, key=score))
        A = se3.adjoint(T_own_camera)
        covariance, comparison = self._checked(other_rows, live, fit.T_camera_world)
        nearest = _nearest_keyframe(other, fit.T_camera_world, target)
        moved = fit.T_camera_world @ other.T_submap_camera[nearest]  # errors grow with the motion from this keyframe
        moved_m = float(np.linalg.norm(moved[:3, 3]))
        covariance = covariance + systematic_errors(moved_m, se3.rotation_angle(moved[:3, :3]))
        T_own_other, covariance = T_own_camera @ fit.T_camera_world, A @ covariance @ A.T
        return Localisation(
            T_own_other, fit.loss, covariance, fit.agreement, fit.overlap, comparison, at_keyframe, (keyframe, nearest)
        )

    def guesses_by_features(
        self, own: Submap, keyframe: int, other: Submap, alike: Sequence[int]
    ) -> Task[list[Matrix]]:
        """Return T_camera_other [4, 4] of a keyframe of `own` by each keyframe of `other` in `alike` whose features
        give a pose; none without an extractor. A long slice ends after each image whose features are found."""
        guesses = list[Matrix]()
        if self.extractor is None or not alike:
            return guesses
        image = yield from self._featured(own, keyframe, self.extractor)
        for k in alike:
            reference = yield from self._featured(other, k, self.extractor)
            found = pose_by_features(reference.landmarks(self.extractor), image, self.extractor, self.seed)
            if found is not None:
                guesses.append(found.T_live_reference @ se3.inverse(other.T_submap_camera[k]))
        return guesses

    def _featured(self, submap: Submap, keyframe: int, extractor: Extractor) -> Task[FeatureImage]:
        """Return the image of a keyframe when its features are found, once for each image."""
        where = submap.index, keyframe
        if where not in self._with_features:
            image = self._with_features[where] = FeatureImage.of_picture(self.store.picture(*where), submap.camera)
            image.features(extractor)
            yield from long_slice()
        return self._with_features[where]

    def _refined(
        self, other: Submap, other_rows: Tensor, target: Target, live: Pyramid, found: PoseFit
    ) -> Task[tuple[PoseFit, bool]]:
        """Refine a keyframe's pose in a submap, in slices; return it, and whether a keyframe of the submap gave it.

        First the keyframe is aligned to the submap's nearest one, if that is wanted. Without a valid result,
        `registration.iterations` of gradient descent on the uncertainty-weighted loss with exposure follow, which take
        ten times as long. Their result is the guess of a second alignment to the nearest keyframe.
        """
        at_keyframe = self._at_keyframe(other, target, live, found)
        yield
        if at_keyframe is not None:
            return at_keyframe, True
        c = self.config
        hopeless = c.judges and score(found) <= HOPELESS * c.share_least
        if found.alignment is not None and (hopeless or not c.iterations):
            return found, False
        found = fit_pose_adam(other_rows, self.view, target, found.T_camera_world, self.tracking, c.iterations)
        yield from long_slice()
        at_keyframe = self._at_keyframe(other, target, live, found)
        return at_keyframe or found, at_keyframe is not None

    def _images_of(self, own: Submap, keyframe: int) -> tuple[Target, Pyramid]:
        """Return a keyframe's recorded image, or the one that its own submap renders at its pose."""
        if self.config.target == "recorded":
            return self._recorded(own, keyframe)
        T_camera_own = se3.inverse(own.T_submap_camera[keyframe])
        self.view.forward(own.field.params.to(self.view.sums.device), T_camera_own)
        maps = PoseMaps.of(self.view)
        depth_m = torch.where(maps.alpha > OPAQUE, maps.depth, 0.0)  # elsewhere there is no reading
        color = (maps.color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
        return picture_images(self.view, Picture(color.cpu().numpy(), depth_m.cpu().numpy()), own.camera)

    def _recorded(self, submap: Submap, keyframe: int) -> tuple[Target, Pyramid]:
        where = submap.index, keyframe
        if where not in self._images:
            self._images[where] = picture_images(self.view, self.store.picture(*where), submap.camera)
        return self._images[where]

    def _all_aligned(self, other: Tensor, live: Pyramid, guesses: Iterable[Matrix]) -> Task[list[PoseFit]]:
        """Align a keyframe to a map with rows `other` [N, 17] from each guess, in slices."""
        fits = list[PoseFit]()
        for guess in guesses:
            fits.append(self._aligned(other, live, guess))
            yield
        return fits

    def _aligned(self, other: Tensor, live: Pyramid, guess: Matrix) -> PoseFit:
        """Align a keyframe to the map rendered at a guess, then again to the map rendered at the result."""
        for _ in range(2):
            reference = map_reference(other, self.view, guess, self.tracking)
            fit = fit_pose_align(reference, live, guess, self.tracking)
            guess = fit.T_camera_world
        return fit

    def _at_keyframe(self, other: Submap, target: Target, live: Pyramid, found: PoseFit) -> PoseFit | None:
        """Align a keyframe that was found in a submap to the recorded image of its nearest keyframe there; return None
        if this is not wanted (`registration.method`) or the result is not valid.

        The map's surfaces are biased while it is young, and all keyframes that are localised in it then agree on a
        wrong pose. Readings are not.
        """
        c = self.config
        if not c.to_keyframe or not bool((target.depth_image > 0).any()):
            return None
        k = _nearest_keyframe(other, found.T_camera_world, target)
        fit = fit_pose_align(self._reference_at(other, k), live, found.T_camera_world, self.tracking)
        return fit if fit.agreement >= c.agreement_least and score(fit) >= c.share_least else None

    def _reference_at(self, submap: Submap, keyframe: int) -> Reference:
        """Return the recorded image of a keyframe, weighted by its submap, as a reference."""
        where = submap.index, keyframe
        if where not in self._references:
            params = submap.field.params.to(self.view.sums.device)
            _, image = self._recorded(submap, keyframe)
            T_camera_submap = se3.inverse(submap.T_submap_camera[keyframe])
            self._references[where] = keyframe_reference(params, self.view, image, T_camera_submap, self.tracking)
        return self._references[where]

    def _checked(self, other: Tensor, live: Pyramid, T_camera_map: Matrix) -> tuple[Matrix, Comparison | None]:
        """Return the covariance [6, 6] of T_camera_map's left twist, estimated by alignment to the map at that pose,
        and, if poses are verified, the comparison with the map there."""
        reference = map_reference(other, self.view, T_camera_map, self.tracking)
        covariance = align(reference.pyramid, live, np.eye(4), 0, self.tracking.align_weight_color).covariance
        comparison = compare(reference.pyramid, live, np.eye(4)) if self.verify else None
        return covariance if np.isfinite(covariance).all() else np.eye(6), comparison

    def _judge(
        self, a: Submap, b: Submap, found: Sequence[Localisation], centre_b: Matrix, T_a_b: Matrix
    ) -> Registration:
        c, scale = self.config, self.view.options.scene_scale
        good = [f for f in found if not c.judges or (f.agreement >= c.agreement_least and score(f) >= c.share_least)]
        good = [f for f in good if f.comparison is None or confirmed(f.comparison)]
        if len(good) < 2:
            best = max(f.agreement * f.overlap for f in found)
            why = f"{len(good)} of {len(found)} keyframes were localised (the best explains {best:.0%})"
            return refused(T_a_b, found, len(good), why)
        agreed = consensus(good, centre_b, c.spread_m * scale, np.deg2rad(c.spread_deg)) if c.judges else good
        if len(agreed) < 2:
            return refused(T_a_b, good, len(agreed), f"the poses of {len(good)} keyframes disagree")
        if c.to_keyframe and not any(f.at_keyframe for f in agreed):
            return refused(T_a_b, agreed, len(agreed), f"only maps agree with {len(agreed)} keyframes, no image does")
        mean = combined(agreed)
        overlap = shared(a, b, mean, c.overlap_m * scale)
        if overlap < c.overlap_least:
            return refused(T_a_b, agreed, len(agreed), f"overlap {overlap:.2f} is below {c.overlap_least}", overlap)
        residual = float(np.mean([f.residual for f in agreed]))
        keyframes = min(agreed, key=lambda f: f.residual).keyframes
        drift = drift_between(a, b, keyframes, mean, scale)
        information = symmetric(np.asarray(np.linalg.inv(mean_covariance(agreed, mean, scale) + drift)))
        return Registration(mean, information, residual, len(agreed), overlap, True, "accepted", keyframes, drift)


def _nearest_keyframe(submap: Submap, T_camera_submap: Matrix, target: Target) -> int:
    """Return the number of the submap's keyframe whose image is the least moved one in a camera with this image."""
    depth_m, T_submap_camera = target.depth_image[target.depth_image > 0], se3.inverse(T_camera_submap)
    mean_m = float(depth_m.double().mean()) if len(depth_m) else np.inf
    return int(np.argmin([se3.angle_between(T, T_submap_camera, mean_m) for T in submap.T_submap_camera]))


def drift_between(a: Submap, b: Submap, keyframes: tuple[int, int], T_a_b: Matrix, scene_scale: float) -> Matrix:
    """Return the covariance [6, 6] of T_a_b's left twist (m, rad) from the drift of both submaps, from their first
    keyframes to the two that were compared.

    The motion between these two keyframes is measured, but the pose graph moves whole submaps.
    """
    A, (in_a, in_b) = se3.adjoint(T_a_b), keyframes
    of_b = drift_to(in_b, b.T_submap_camera, scene_scale)
    return symmetric(drift_to(in_a, a.T_submap_camera, scene_scale) + A @ of_b @ A.T)


class LocalisationConfig(TrackingConfig):
    """The settings for localising keyframes: fits stop at a plateau of the loss."""

    plateau_stop: ClassVar[float] = 1e-4


def tracking_of(config: Config) -> TrackingConfig:
    """Return the settings for localising keyframes: alignment as in tracking, loss and descent as in registration.

    The loss is a mean over all pixels (VarSplat §5). Tracking sums the colour errors over the channels; where
    registration takes their mean, the weight of colour is a third of that. Adam does not depend on the loss's scale.
    """
    r, tracking = config.registration, config.tracking
    weight_color = r.weight_color
    if r.color_mean == "values":
        weight_color /= weight_color + 3.0 * (1.0 - weight_color)
    same = dataclasses.replace(
        tracking, uncertainty=r.uncertainty, tau=r.tau, weight_color=weight_color,
        lr_rotation=r.lr_rotation, lr_translation=r.lr_translation * config.render.scene_scale,
        exposure=r.exposure, alpha_power=1.0, alpha_above=OPAQUE, outlier_factor=0.0,
        descent="quaternion", align_depth_by="V",
    )  # fmt: skip
    return LocalisationConfig(**vars(same))


def score(fit: PoseFit | Localisation) -> float:
    """Return the share of a keyframe that its pose explains, in [0, 1]: agreement × overlap."""
    return fit.agreement * fit.overlap


def shared(a: Submap, b: Submap, T_a_b: Matrix, distance_m: float) -> float:
    """Return the share of splats with a neighbour nearer than `distance_m` in the other submap, after T_a_b [4, 4]: the
    larger share of the two submaps.

    The paper computes it before registration, at the current poses; drift could then hide an overlap.
    """
    points_a = a.field.means.double().numpy()
    points_b = b.field.means.double().numpy() @ T_a_b[:3, :3].T + T_a_b[:3, 3]
    if not len(points_a) or not len(points_b):
        return 0.0
    shares = []
    for ours, theirs in ((points_a, points_b), (points_b, points_a)):
        some = ours[:: max(1, len(ours) // OVERLAP_SAMPLE)]
        nearest = cKDTree(theirs).query(some, distance_upper_bound=distance_m)[0]
        shares.append(float(np.isfinite(nearest).mean()))
    return max(shares)


def refused(
    T_a_b: Matrix, found: Sequence[Localisation], localised: int, reason: str, overlap: float = 0.0
) -> Registration:
    """Return a refused registration with zero information, which keeps T_a_b [4, 4]."""
    residual = float(np.mean([f.residual for f in found]))
    return Registration(T_a_b, np.zeros((6, 6)), residual, localised, overlap, False, reason)
