"""Render and score the views of a run: at working resolution, at the resolution of the recording, and test views.

Scores at different resolutions are never mixed: each resolution has its own object in metrics.json.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sigmasplat.api as api
from sigmasplat.api import Camera, Config, InputConfig, Progress, Readout, Source, se3
from sigmasplat.plugins.evaluation import view_scores
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.evaluation.view_scores import ScoredView
from sigmasplat.plugins.outputs.drawing.view_panels import ViewPanel, view_panels

Scores = dict[str, view_scores.ViewScores]
HEADINGS = {"test": "novel views"}
"""Headings of kinds of views; without an entry "<kind> views"."""


class ViewStrips:
    """Collect the panels of a few views of each kind for the page, by heading."""

    def __init__(self, per_kind: int) -> None:
        self.per_kind = per_kind
        self.panels: dict[str, list[list[ViewPanel]]] = {}

    def add(self, view: ScoredView, place: str = "") -> None:
        """Keep the panels of a view; `place` is added to the heading if it was not rendered from the final map."""
        heading = HEADINGS.get(view.kind, f"{view.kind} views") + place
        self.panels.setdefault(heading, []).append(view_panels(view))


@dataclass(frozen=True, eq=False)
class ViewScoring:
    """What every scoring of views needs.

    input: the run's settings of working images; chosen: the log records of the scored views by kind; most: the largest
    number of test views; T_estimate_truth [4, 4]: the alignment of the ATE, None without a truth; lpips: the network of
    LPIPS, if it is scored; readouts: when the rows of each frame were read, where it is known.
    """

    source: Source
    input: InputConfig
    maps: view_scores.MapSources
    chosen: Mapping[str, list[dict[str, Any]]]
    renderer: view_scores.Renderer
    most: int
    T_estimate_truth: NDArray[np.float64] | None
    lpips: Lpips | None = None
    readouts: Mapping[int, Readout] = field(default_factory=dict)

    def scores(
        self, settings: InputConfig, progress: Progress, see: Callable[[ScoredView, ScoredView | None], None] | None
    ) -> tuple[Scores, Scores]:
        """Render the chosen views at the size of `settings` (`view_scores.render_views`), and score them by kind, in
        the final map and in their submaps. Calls `see` with both renders of a view, and `progress(done, total)`."""
        final, before = ({kind: view_scores.ViewScores(self.lpips) for kind in self.chosen} for _ in range(2))
        read = partial(working_frame, self.source, settings, readouts=self.readouts)
        views, total = (
            view_scores.render_views(read, self.maps, self.chosen, self.renderer),
            sum(map(len, self.chosen.values())),
        )
        for done, (view, in_submap) in enumerate(views, 1):
            final[view.kind].add(view)
            if in_submap:
                before[view.kind].add(in_submap)
            if see:
                see(view, in_submap)
            progress(done, total)
        return final, before


def full_width(config: Config, camera: Camera) -> int | None:
    """Return the width of the images that the last stage of the final map used; None without that stage.

    camera: of the recording.
    """
    final, settings = config.final, config.input
    size = api.photo_size(camera, settings.width, settings.crop_px, final.width)
    return min(final.width, camera.width) if size and final.iterations else None


def refined_fx(config: Config, camera: Camera) -> float | None:
    """Return the focal length, pixels, of the images that the last stage of the final map used; None without that
    stage.

    camera: of the recording.
    """
    width = full_width(config, camera)
    return None if width is None else camera.prepared(width).fx


def score_full_resolution(
    scoring: ViewScoring, config: Config, recorded: bool, progress: Progress = api.no_progress
) -> dict[str, Any] | None:
    """Score the chosen views and the test views at the size of the recording if `recorded`, else views that were not
    fitted at that of the final map's last stage; None without that stage.

    Returns width, height, and the keys of the scores at working resolution: training (None unless `recorded`),
    held_out, both in their submaps, and test_views. Calls `progress(done, total)` with the chosen views.
    """
    width = scoring.source.camera.width if recorded else full_width(config, scoring.source.camera)
    if width is None:
        return None
    scale = width / (scoring.input.width or scoring.source.camera.width)
    settings = replace(scoring.input, width=width, crop_px=round(scoring.input.crop_px * scale))  # crops the same part
    camera = scoring.source.camera.prepared(settings.width, settings.crop_px)
    chosen = {kind: views if recorded or kind != "training" else [] for kind, views in scoring.chosen.items()}
    unpredicted = replace(scoring, chosen=chosen, maps=replace(scoring.maps, predict=None))
    scores = view_scores.kind_scores(*unpredicted.scores(settings, progress, None), scoring.maps)
    scores |= {"test_views": score_test_views(scoring, settings)}
    return {"width": camera.width, "height": camera.height} | scores


def score_test_views(
    scoring: ViewScoring, settings: InputConfig, strips: ViewStrips | None = None
) -> dict[str, Any] | None:
    """Render the final map at the true poses of the source's test views at the size of `settings`; return their mean
    scores as `view_scores.mean_scores` does, None without test views, their poses or a truth.

    The alignment of the ATE transforms the poses to the estimate's world. So errors of the path lower these scores, as
    in the papers. Adds a few views to `strips`, if given. Unreadable views and those without a pose are skipped.
    """
    test_views, T_estimate_truth = scoring.source.test_views(), scoring.T_estimate_truth
    poses = None if test_views is None else test_views.truth()
    if test_views is None or poses is None or T_estimate_truth is None:
        return None
    rendered = []
    for i in api.evenly_spread(range(len(test_views)), scoring.most):
        try:
            frame = working_frame(test_views, settings, i)
        except api.SourceError:
            continue
        rows, found = associate(np.array([frame.timestamp_s]), poses.timestamps_s)
        if len(rows):
            T_camera_world = se3.inverse(T_estimate_truth @ poses.T_world_camera[found[0]])
            seen = scoring.renderer(scoring.maps.final, frame.camera, T_camera_world)
            rendered.append(view_scores.scored_view(frame, seen, "test"))
    if strips is not None:
        for view in rendered[:: max(1, len(rendered) // max(strips.per_kind, 1))][: strips.per_kind]:
            strips.add(view)
    return view_scores.mean_scores([view.scores(scoring.lpips) for view in rendered])


def working_frame(
    source: Source, settings: InputConfig, index: int, readouts: Mapping[int, Readout] | None = None
) -> api.Frame:
    """Read a frame at the resolution, depth range and crop that SLAM works with, and as if all rows had been read at
    once where it is known when they were (readouts, by frame). Raises SourceError if unreadable."""
    s = settings
    frame = source.frame(index).prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)
    known = (readouts or {}).get(index)
    return frame if known is None else api.read_at_once(frame, replace(known, late_s=frame.depth_late_s))
