"""Score a finished run: the only place that reads ground truth. Writes metrics.json, images/ and report.html."""

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat import surface
from sigmasplat.config import Config
from sigmasplat.errors import RunError, SourceError
from sigmasplat.io.runs import RunFolder
from sigmasplat.metrics import plot, views
from sigmasplat.metrics.panels import COVERED_ALPHA, View, side_by_side
from sigmasplat.metrics.report import Contents, build_report
from sigmasplat.metrics.trajectory import align_rigid, associate, ate, rpe
from sigmasplat.model import se3
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import GaussianField
from sigmasplat.model.frame import Frame
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.render import Render, render
from sigmasplat.sources.base import Source

SAME_TIME_S = 1e-4
"""Log and trajectory hold the same timestamps up to printing."""

Log = list[dict[str, Any]]


Renderer = Callable[[GaussianField, Camera, NDArray[np.float64]], Render]
Progress = Callable[[int, int], None]


def evaluate(
    run: RunFolder,
    source: Source,
    *,
    renderer: Renderer | None = None,
    views_per_kind: int = 40,
    strips_per_kind: int = 6,
    mesh: bool = False,
    progress: Progress = lambda done, total: None,
) -> dict[str, Any]:
    """Score trajectory, map and uncertainty of a run against its source, and return the metrics written.

    Training views are the run's keyframes, held-out views the frames that no map was fitted to; of each at most
    `views_per_kind`, evenly spread. Both are rendered at the estimated poses, at the run's working resolution, with the
    run's render settings unless a `renderer` is given. `progress` is told (views done, of how many).
    With `mesh` the keyframes are fused into mesh.ply, which is scored where the source knows its true surface.
    Raises RunError if the run stopped before it had a map; SourceError if the truth shares no timestamps with the run,
    after everything else has been written.
    """
    records = run.read_log()
    if not records:
        raise RunError(f"run {run.path} has an empty log.jsonl: it stopped before its first frame; run it again")
    path, field = run.read_trajectory(), run.read_map()
    log = _posed(records, path, run)
    truth = source.truth()
    path_scores, problem = _path_scores(path, truth)
    chosen = {kind: _spread(records, views_per_kind) for kind, records in _kinds(log).items()}
    gallery, config = Gallery(run, strips_per_kind), run.config()
    renderer = renderer or partial(render, options=config.render, backend=config.backend)
    scores = _score_views(config, source, field, chosen, gallery, renderer, progress)
    metrics = _facts(run, source, log, field) | path_scores | scores | {"reconstruction": None}
    if mesh:
        known = None if problem else truth
        found = surface.fuse_and_score(run, source.camera, source.true_surface(), known, renderer, progress)
        metrics["reconstruction"] = found
    run.write_metrics(metrics)
    plots = _draw_plots(run, log, None if problem else truth)
    warnings = [str(problem)] if problem else []
    title, settings = f"SigmaSplat · {source.name}", json.dumps(run.config().to_dict(), indent=2)
    run.write_report(build_report(Contents(title, _subtitle(run), metrics, gallery.strips, plots, settings, warnings)))
    if problem:
        raise problem
    return metrics


class Gallery:
    """Draw the strips of a few views of each kind into images/ and remember their names for the report."""

    def __init__(self, run: RunFolder, per_kind: int) -> None:
        """Start empty; strips of an earlier evaluation are removed, since the views may differ."""
        self.run, self.per_kind = run, per_kind
        self.strips: dict[str, list[str]] = {}
        for old in run.images.glob("view-*.png"):
            old.unlink()

    def add(self, view: View) -> None:
        """Draw one view."""
        name = f"view-{view.kind.replace(' ', '-')}-{view.index:06d}.png"
        self.run.write_image(name, side_by_side(view))
        self.strips.setdefault(f"{view.kind} views", []).append(f"images/{name}")


def _posed(log: Log, path: Trajectory, run: RunFolder) -> Log:
    """Return the log's records that have a pose, each with its `T_world_camera` [4, 4]. Raises RunError if none has."""
    times = np.array([record["timestamp_s"] for record in log], np.float64)
    rows, poses = associate(times, path.timestamps_s, SAME_TIME_S)
    if not len(rows):
        raise RunError(f"run {run.path}: trajectory.txt and log.jsonl share no timestamps; are they of one run?")
    return [log[row] | {"T_world_camera": path.T_world_camera[pose]} for row, pose in zip(rows, poses, strict=True)]


def _kinds(log: Log) -> dict[str, Log]:
    """Split the frames by whether the map was fitted to them."""
    return {
        "held-out": [record for record in log if not record["is_keyframe"]],
        "training": [record for record in log if record["is_keyframe"]],
    }


def _spread(records: Log, most: int) -> Log:
    """Choose at most `most` records, evenly spread, first and last among them."""
    rows = np.unique(np.linspace(0, len(records) - 1, min(most, len(records))).round().astype(int))
    return [records[row] for row in rows]


def _path_scores(path: Trajectory, truth: Trajectory | None) -> tuple[dict[str, Any], SourceError | None]:
    """Return ATE and RPE over all frames (None without truth), and the reason if the truth does not fit."""
    if truth is None:
        return {"ate": None, "rpe": None}, None
    try:
        return {"ate": asdict(ate(path, truth)), "rpe": asdict(rpe(path, truth))}, None
    except SourceError as problem:
        return {"ate": None, "rpe": None}, problem


def _score_views(
    config: Config, source: Source, field: GaussianField, chosen: dict[str, Log], gallery: Gallery,
    renderer: Renderer, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """Render and score the chosen views; average the scores per kind; judge V on the held-out views."""
    total, done = sum(len(records) for records in chosen.values()), 0
    scores: dict[str, list[dict[str, float]]] = {kind: [] for kind in chosen}
    samples: list[NDArray[np.float32]] = []
    for kind, records in chosen.items():
        shown = {record["index"] for record in _spread(records, gallery.per_kind)}
        for record in records:
            view = _view(config, source, field, record, kind, renderer)
            scores[kind].append(view.scores())
            if kind == "held-out":
                samples.append(views.sample(view))
            if view.index in shown:
                gallery.add(view)
            done += 1
            progress(done, total)
    averages = {kind.replace("-", "_"): views.average(rows) for kind, rows in scores.items()}
    return averages | {"uncertainty": views.judge(samples)}


def _view(
    config: Config, source: Source, field: GaussianField, record: dict[str, Any], kind: str, renderer: Renderer
) -> View:
    """Render one frame's view at its estimated pose; depth is Σwz/Σw where the map covers the pixel, else 0."""
    settings = config.input
    frame: Frame = source.frame(record["index"]).prepared(settings.width, settings.min_depth_m, settings.max_depth_m)
    rendered = renderer(field, frame.camera, se3.inverse(record["T_world_camera"]))
    alpha = _array(rendered.alpha)
    depth = np.where(alpha > COVERED_ALPHA, _array(rendered.depth) / np.maximum(alpha, COVERED_ALPHA), 0.0)
    return View(
        record["index"], kind, frame.color, frame.depth_m, np.clip(_array(rendered.color), 0.0, 1.0),
        depth.astype(np.float32), alpha, _array(rendered.variance), ("lost",) if record.get("lost") else (),
    )  # fmt: skip


def _array(values: Tensor) -> NDArray[np.float32]:
    """Turn a tensor of any device into a numpy array."""
    return np.asarray(values.detach().cpu(), np.float32)


def _facts(run: RunFolder, source: Source, log: Log, field: GaussianField) -> dict[str, Any]:
    """Return what can be counted: frames, keyframes, lost frames, splats, speed."""
    lost = [record["index"] for record in log if record.get("lost")]
    return {
        "source": source.name,
        "status": run.facts().get("status"),
        "frames": len(log),
        "keyframes": sum(bool(record["is_keyframe"]) for record in log),
        "lost": len(lost),
        "lost_frames": lost,
        "skipped": run.facts().get("skipped", list(source.skipped)),
        "splats": len(field),
        "frames_per_s": _frames_per_s(run, log),
    }


def _seconds(record: dict[str, Any]) -> float:
    """Return the time one frame took: its `total`, or the sum of its stages."""
    stages: dict[str, float] = record.get("seconds") or {}
    return float(stages.get("total", sum(stages.values())))


def _frames_per_s(run: RunFolder, log: Log) -> float | None:
    """Return the speed end to end: by the wall clock (run.json, wall_s) if noted, else by the frames' own times."""
    seconds = run.facts().get("wall_s") or sum(_seconds(record) for record in log)
    return len(log) / seconds if seconds else None


def _draw_plots(run: RunFolder, log: Log, truth: Trajectory | None) -> dict[str, str]:
    """Draw path and times in both themes; return the captions by name."""
    lost = np.array([bool(record.get("lost")) for record in log])
    estimate = np.array([record["T_world_camera"][:3, 3] for record in log])
    charts = {"trajectory": plot.trajectory_charts(estimate, _aligned_truth(log, estimate, truth), lost)}
    captions = {"trajectory": "In the frame of the first camera." + (" The truth is rigidly aligned." if truth else "")}
    if any(_seconds(record) for record in log):
        stages = {name: np.array([(r.get("seconds") or {}).get(name, 0.0) for r in log]) for name in _stages(log)}
        stages["total"] = np.array([_seconds(record) for record in log])
        charts["seconds"] = [plot.seconds_chart(np.array([record["index"] for record in log]), stages)]
        captions["seconds"] = "Seconds each frame took, end to end; keyframes carry the mapping."
    for name, drawn in charts.items():
        for theme in (plot.LIGHT, plot.DARK):
            size = plot.SIZE if len(drawn) > 1 else (plot.SIZE[0], 300)
            run.write_image(f"{name}-{theme.name}.png", plot.draw_charts(drawn, theme, size))
    return captions


def _aligned_truth(log: Log, estimate: NDArray[np.float64], truth: Trajectory | None) -> NDArray[np.float64] | None:
    """Return the true positions of the logged frames [N, 3], m, in the estimate's world; nan where none is known."""
    if truth is None:
        return None
    rows, truth_rows = associate(np.array([record["timestamp_s"] for record in log]), truth.timestamps_s)
    theirs = truth.T_world_camera[truth_rows, :3, 3]
    T_estimate_truth = align_rigid(theirs, estimate[rows])
    out = np.full_like(estimate, np.nan)
    out[rows] = theirs @ T_estimate_truth[:3, :3].T + T_estimate_truth[:3, 3]
    return out


def _stages(log: Log) -> list[str]:
    """Return the names of the first three stages timed."""
    return [name for name in (log[0].get("seconds") or {}) if name != "total"][:3]


def _subtitle(run: RunFolder) -> str:
    """Say what made the run: settings, version, machine, status."""
    facts = run.facts()
    made_on = facts.get("machine") or {}
    machine = f"{made_on.get('cpu')}, {made_on.get('cores')} cores"
    return " · ".join([run.config().name, f"version {facts.get('version')}", machine, str(facts.get("status"))])
