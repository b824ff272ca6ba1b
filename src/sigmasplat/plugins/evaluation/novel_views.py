"""Score novel views: test photographs of a data set, taken from poses that no frame of the sequence has."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sigmasplat.config import InputConfig
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.selection import evenly_spread
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import SourceError
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics import views
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.evaluation.report.view_strips import ViewStrips
from sigmasplat.plugins.evaluation.view_selection import working_frame

KIND = "test"


def score_novel_views(
    test_views: Source,
    poses: Trajectory | None,
    T_estimate_truth: NDArray[np.float64],
    field: GaussianField,
    settings: InputConfig,
    renderer: views.Renderer,
    strips: ViewStrips | None,
    most: int,
    lpips: Lpips | None = None,
) -> dict[str, Any] | None:
    """Render the final map at the true poses of at most `most` test views, and return their mean scores.

    `T_estimate_truth`, the alignment of the ATE, transforms the poses to the estimate's world. So errors of the path
    lower these scores, as in the papers. Adds a few views to `strips`, if given. Unreadable views and those without a
    pose are skipped. Returns the scores as `views.mean_scores` does, or None if no poses are known.
    """
    if poses is None:
        return None
    rendered = []
    for i in evenly_spread(range(len(test_views)), most):
        try:
            frame = working_frame(test_views, settings, i)
        except SourceError:
            continue
        rows, found = associate(np.array([frame.timestamp_s]), poses.timestamps_s)
        if len(rows):
            T_camera_world = se3.inverse(T_estimate_truth @ poses.T_world_camera[found[0]])
            rendered.append(views.scored_view(frame, renderer(field, frame.camera, T_camera_world), KIND))
    if strips is not None:
        for view in rendered[:: max(1, len(rendered) // max(strips.per_kind, 1))][: strips.per_kind]:
            strips.add(view)
    return views.mean_scores([view.scores(lpips) for view in rendered])
