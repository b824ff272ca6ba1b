"""Render many views and summarise their scores: means per kind of view, and scores of V over all sampled pixels."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import Camera, Frame, GaussianField, Predicted, Render, SubmapStore, exposed, se3
from sigmasplat.plugins.evaluation.metrics import uncertainty
from sigmasplat.plugins.evaluation.metrics.image import SSIM_LEAST_PX, depth_l1, ms_ssim, psnr, similarity_factors, ssim
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips

COVERED_ALPHA = 0.5
"""Above this alpha a pixel counts as covered by the map: its depth is Σwz / Σw."""


class PredictedErrors(NamedTuple):
    """What a map predicts of the errors of a view, variances [H, W]: of colour (mean over channels, colour²), and of
    the difference between rendered depth and a reading of the sensor (m²)."""

    color: NDArray[np.float32]
    reading_m2: NDArray[np.float32]


def as_array(values: Tensor) -> NDArray[np.float32]:
    """Return values of any device as an array."""
    return np.asarray(values.detach().cpu(), np.float32)


@dataclass(frozen=True, eq=False)
class ScoredView:
    """A recorded image and its rendering at the estimated pose, float32.

    recorded, rendered: [H, W, 3] in [0, 1]; recorded_depth_m [H, W] (0 = no reading); rendered_depth_m [H, W]
    (0 where alpha ≤ ½); alpha [H, W]; variance: V [H, W, 3], colour² (VarSplat §1); notes: shown below the view strip;
    predicted: the predictive variances, None if they are not known; neutral [H, W, 3]: the rendering in the exposure of
    the map, None if it is `rendered`.
    """

    index: int
    kind: str
    recorded: NDArray[np.float32]
    recorded_depth_m: NDArray[np.float32]
    rendered: NDArray[np.float32]
    rendered_depth_m: NDArray[np.float32]
    alpha: NDArray[np.float32]
    variance: NDArray[np.float32]
    notes: tuple[str, ...] = field(default=())
    predicted: PredictedErrors | None = None
    neutral: NDArray[np.float32] | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Return which pixels have a depth reading [H, W]. Scores use only these pixels, unless they say otherwise."""
        return self.recorded_depth_m > 0

    @property
    def uncertainty(self) -> NDArray[np.float32]:
        """Return V averaged over the channels [H, W], colour². Negative values (rounding) become 0."""
        return np.asarray(np.maximum(self.variance.mean(-1), 0.0), np.float32)

    @property
    def squared_errors(self) -> NDArray[np.float32]:
        """Return (Ĉ − C)² of each channel [H, W, 3], colour²."""
        return np.asarray((self.rendered - self.recorded) ** 2, np.float32)

    @property
    def squared_error(self) -> NDArray[np.float32]:
        """Return (Ĉ − C)² averaged over the channels [H, W], colour²."""
        return np.asarray(self.squared_errors.mean(-1), np.float32)

    def scores(self, lpips: Lpips | None = None) -> dict[str, float]:
        """Return the scores of the view.

        PSNR (dB), SSIM, depth L1 (m) and the share of depth readings that the map covers use the valid pixels. PSNR of
        the image (dB), MS-SSIM and LPIPS use all pixels, as published systems do; nan if they are not known. The
        neutral PSNR (dB, valid pixels) is that of the rendering in the exposure of the map.
        """
        valid = self.valid
        covered = float((self.rendered_depth_m > 0)[valid].mean()) if valid.any() else float("nan")
        factors = similarity_factors(self.rendered, self.recorded) if min(valid.shape) >= SSIM_LEAST_PX else None
        return {
            "psnr_db": psnr(self.rendered, self.recorded, valid),
            "psnr_neutral_db": psnr(self.rendered if self.neutral is None else self.neutral, self.recorded, valid),
            "ssim": ssim(self.rendered, self.recorded, valid, factors),
            "depth_l1_m": depth_l1(self.rendered_depth_m, self.recorded_depth_m),
            "depth_coverage": covered,
            "psnr_image_db": psnr(self.rendered, self.recorded),
            "ms_ssim": ms_ssim(self.rendered, self.recorded, factors),
            "lpips": lpips.distance(self.rendered, self.recorded) if lpips else float("nan"),
        }


Renderer = Callable[[GaussianField, Camera, NDArray[np.float64]], Render]
"""Renders a field from T_camera_world."""
Predictor = Callable[[Camera, NDArray[np.float64]], Predicted]
"""Predicts the variances of a view of the final map from T_camera_world."""
HELD_OUT, PIXELS_PER_VIEW = "held-out", 20_000
"""The kind of views that no map was fitted to. At most this many valid pixels per view, every k-th one, go into the
uncertainty scores: sorting stays fast."""


@dataclass(eq=False)
class ViewScores:
    """Scores of the views of one kind, with LPIPS if given, and samples of their pixels to score V over all views."""

    lpips: Lpips | None = None
    rows: list[dict[str, float]] = field(default_factory=list)
    samples: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, view: ScoredView) -> None:
        """Score a view."""
        self.rows.append(view.scores(self.lpips))
        self.samples.append(sample_pixels(view))


@dataclass(frozen=True, eq=False)
class MapSources:
    """The maps that views are rendered from: the final map, and the submaps if T_world_submap [S, 4, 4] is known.

    predict: predicts the variances of views of the final map; None if it was not measured how sure the map is.
    T_submap_camera [F, 4, 4]: the pose of each frame in its submap, which differs from the pose in the world if the
    refinement of the final map has moved keyframes; None: it follows from the pose in the world.
    exposures [F, 3, 2]: those of the frames relative to the final map (`data.camera.exposed`); None: not fitted.
    """

    final: GaussianField
    store: SubmapStore
    T_world_submap: NDArray[np.float64] | None
    predict: Predictor | None = None
    T_submap_camera: NDArray[np.float64] | None = None
    exposures: NDArray[np.float64] | None = None

    def exposure(self, record: Mapping[str, Any]) -> NDArray[np.float64] | None:
        """Return the exposure [3, 2] of a view relative to the final map; None if exposures are not fitted."""
        return None if self.exposures is None or "row" not in record else self.exposures[record["row"]]

    def T_camera_submap(self, record: Mapping[str, Any]) -> NDArray[np.float64] | None:
        """Return the pose [4, 4] of a view that the splats of its submap were fitted to; None if the run kept no
        submaps."""
        if self.T_world_submap is None:
            return None
        if self.T_submap_camera is not None and "row" in record:
            return se3.inverse(self.T_submap_camera[record["row"]])
        T_world_submap = self.T_world_submap[record.get("submap", 0)]
        return np.asarray(se3.inverse(record["T_world_camera"]) @ T_world_submap)

    def submap(self, index: int) -> GaussianField | None:
        """Return the splats of a submap in its own frame; None if the run kept no submaps."""
        return None if self.T_world_submap is None else self.store.load(index).field


def render_views(
    frame_of: Callable[[int], Frame], maps: MapSources, chosen: Mapping[str, list[dict[str, Any]]], renderer: Renderer
) -> Iterator[tuple[ScoredView, ScoredView | None]]:
    """Render the chosen records of each kind at their `T_world_camera`, in the final map and, if kept, in their submap.

    `submap` of a record names its submap (default 0). Views are ordered by submap: each submap is loaded once, and only
    one is in memory. Variances are predicted for held-out views only: the map was fitted to training views, so their
    errors are smaller.
    """
    wanted = [(record.get("submap", 0), kind, record) for kind, records in chosen.items() for record in records]
    for index, group in groupby(sorted(wanted, key=lambda view: view[0]), key=lambda view: view[0]):
        submap = maps.submap(index)
        for _, kind, record in group:
            frame, T_camera_world = frame_of(record["index"]), se3.inverse(record["T_world_camera"])
            rendered = renderer(maps.final, frame.camera, T_camera_world)
            final = scored_view(frame, rendered, kind, exposure=maps.exposure(record))
            if maps.predict is not None and kind == HELD_OUT:
                found = maps.predict(frame.camera, T_camera_world)
                final = replace(final, predicted=PredictedErrors(as_array(found.color), as_array(found.reading_m2)))
            before = None
            T_camera_submap = maps.T_camera_submap(record)
            if submap is not None and T_camera_submap is not None:
                rendered = renderer(submap, frame.camera, T_camera_submap)
                before = scored_view(frame, rendered, kind, (f"in submap {index}",))
            yield final, before


def scored_view(
    frame: Frame, rendered: Render, kind: str, notes: tuple[str, ...] = (), exposure: NDArray[np.float64] | None = None
) -> ScoredView:
    """Pair a frame with its rendering, in the frame's exposure [3, 2] if given. Depth is Σwz/Σw where the map covers
    the pixel, else 0."""
    alpha, neutral = as_array(rendered.alpha), np.clip(as_array(rendered.color), 0.0, 1.0)
    shown = neutral if exposure is None else exposed(as_array(rendered.color), exposure)
    depth = np.where(alpha > COVERED_ALPHA, as_array(rendered.depth) / np.maximum(alpha, COVERED_ALPHA), 0.0)
    return ScoredView(
        frame.index, kind, frame.color, frame.depth_m, shown, depth.astype(np.float32), alpha,
        as_array(rendered.variance), notes, neutral=neutral,
    )  # fmt: skip


def sample_pixels(view: ScoredView) -> NDArray[np.float32]:
    """Return (V, squared error, alpha) [3, P] of every k-th pixel with a depth reading, at most `PIXELS_PER_VIEW`."""
    return _every_kth(np.stack([plane[view.valid] for plane in (view.uncertainty, view.squared_error, view.alpha)]))


def mean_scores(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Average each score over the views that have it; None if no view has it. `views` is the number of views."""
    columns = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}
    return {"views": len(rows)} | {name: _mean(column) for name, column in columns.items()}


def kind_scores(final: Mapping[str, ViewScores], before: Mapping[str, ViewScores], maps: MapSources) -> dict[str, Any]:
    """Return the mean scores of each kind of views in the final map, and in their submaps (None if they are not
    kept)."""
    kept = maps.T_world_submap is not None
    found: dict[str, Any] = {kind: mean_scores(final[kind].rows) for kind in final}
    found |= {f"{kind}_submaps": mean_scores(before[kind].rows) if kept else None for kind in final}
    return {name.replace("-", "_"): scores for name, scores in found.items()}


def score_uncertainty(samples: list[NDArray[np.float32]], judged_on: str = "held-out") -> dict[str, Any] | None:
    """Score V against the squared error over all sampled pixels (`uncertainty.score`); None without pixels.

    Adds judged_on (the kind of the views), spearman_covered (only pixels that the map covers) and spearman_per_view
    (mean of the correlations per view).
    """
    if not sum(part.shape[1] for part in samples):
        return None
    variance, squared_error, alpha = np.concatenate(samples, axis=1)
    covered = alpha > COVERED_ALPHA
    return uncertainty.score(variance, squared_error) | {
        "judged_on": judged_on,
        "spearman_covered": uncertainty.spearman(variance[covered], squared_error[covered]),
        "spearman_per_view": _mean(np.array([uncertainty.spearman(part[0], part[1]) for part in samples])),
    }


@dataclass(eq=False)
class PredictionScores:
    """Samples of views with predictive variances, of the pixels that V is scored on: variance and the squared error of
    each channel, [1 + C, P].

    Frames in `calibrated_on` are left out, because the weights of the parts were fitted to them.
    """

    calibrated_on: frozenset[int] = frozenset()
    color: list[NDArray[np.float32]] = field(default_factory=list)
    depth: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, view: ScoredView) -> None:
        """Sample a view if it has predictive variances."""
        found = view.predicted
        if found is None or view.index in self.calibrated_on:
            return
        read, compared = view.valid, view.valid & (view.rendered_depth_m > 0)
        self.color.append(_every_kth(np.stack([found.color[read], *view.squared_errors[read].T])))
        squares = np.asarray((view.rendered_depth_m - view.recorded_depth_m) ** 2, np.float32)
        self.depth.append(_every_kth(np.stack([found.reading_m2[compared], squares[compared]])))

    def scores(self) -> dict[str, Any] | None:
        """Return the number of views, and the scores of colour and depth over all their pixels; None without views."""
        if not self.color:
            return None
        return {"views": len(self.color), "color": _calibrated(self.color), "depth": _calibrated(self.depth)}


def _calibrated(samples: list[NDArray[np.float32]]) -> dict[str, Any] | None:
    """Return all scores of a variance with a unit; None without pixels."""
    variance, *channels = np.concatenate(samples, axis=1)
    if not variance.size:
        return None
    squared_error = np.stack(channels, -1)
    of_mean = uncertainty.score(variance, uncertainty.over_channels(variance, squared_error))
    return of_mean | uncertainty.calibration_scores(variance, squared_error)


def _every_kth(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return every k-th column, at most `PIXELS_PER_VIEW`."""
    return values[:, :: max(1, -(-values.shape[1] // PIXELS_PER_VIEW))]


def _mean(values: NDArray[np.float64]) -> float | None:
    """Return the mean of the values that are not nan; None if all are nan."""
    existing = values[~np.isnan(values)]
    return float(existing.mean()) if len(existing) else None
