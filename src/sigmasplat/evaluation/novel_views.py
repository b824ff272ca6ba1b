"""Score views that a data set keeps apart from its walk: photographs from places that no frame was taken at."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.errors import SourceError
from sigmasplat.metrics import views
from sigmasplat.metrics.trajectory import associate
from sigmasplat.model import se3
from sigmasplat.model.field import GaussianField
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.report.view_strips import ViewStrips
from sigmasplat.sources.base import Source

KIND = "test"


def score_novel_views(
    apart: Source,
    poses: Trajectory | None,
    T_estimate_truth: NDArray[np.float64],
    field: GaussianField,
    settings: InputConfig,
    renderer: views.Renderer,
    strips: ViewStrips,
    most: int,
) -> dict[str, Any] | None:
    """Render the final map at the true poses of at most `most` views, taken to the estimate's world by the ATE's fit.

    Returns their mean scores (`views.mean_scores`), and draws a few; None where no poses are known. The path's error
    counts against them, as it does in the papers. Unreadable views and those without a pose are left out.
    """
    if poses is None:
        return None
    seen = []
    for i in np.unique(np.linspace(0, len(apart) - 1, min(most, len(apart))).round().astype(int)).tolist():
        try:
            frame = apart.frame(i).prepared(
                settings.width, settings.min_depth_m, settings.max_depth_m, settings.crop_px
            )  # fmt: skip
        except SourceError:
            continue
        rows, found = associate(np.array([frame.timestamp_s]), poses.timestamps_s)
        if len(rows):
            T_camera_world = se3.inverse(T_estimate_truth @ poses.T_world_camera[found[0]])
            seen.append(views.scored_view(frame, renderer(field, frame.camera, T_camera_world), KIND))
    for view in seen[:: max(1, len(seen) // max(strips.per_kind, 1))][: strips.per_kind]:
        strips.add(view)
    return views.mean_scores([view.scores() for view in seen])
