"""Score a finished run; only this folder reads ground truth. Writes metrics.json and report.html."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

import sigmasplat.api as api
from sigmasplat.api import FinalConfig, GaussianField, Matrix, RunError, RunFolder, RunFrames, Source, Trajectory
from sigmasplat.plugins.evaluation import reconstruct, run_views, view_scores
from sigmasplat.plugins.evaluation.failure import failure, scale_to_truth, wrong_scale
from sigmasplat.plugins.evaluation.metrics.lpips import Lpips
from sigmasplat.plugins.evaluation.metrics.published_reconstruction import VIEWS
from sigmasplat.plugins.evaluation.metrics.trajectory import associate, score_path, truth_in_estimate
from sigmasplat.plugins.evaluation.path_scores import (
    arbitrary_scale,
    in_metres,
    in_units_of_run,
    score_frame_sets,
    score_pose_covariance,
    score_states,
)
from sigmasplat.plugins.evaluation.report import charts
from sigmasplat.plugins.evaluation.report.page import report_plan, write_page
from sigmasplat.plugins.evaluation.run_views import ViewScoring, ViewStrips
from sigmasplat.plugins.evaluation.view_scores import ScoredView

Log = list[dict[str, Any]]
KINDS = {"held-out": False, "training": True}
"""Whether a map was fitted to the views of a kind."""


def evaluate(
    run: RunFolder, source: Source, *, renderer: view_scores.Renderer | None = None, views_per_kind: int = 40,
    strips_per_kind: int = 3, mesh: bool = False, true_mesh: api.Mesh | None = None, random_views: int = VIEWS,
    full_resolution: bool = False, lpips: Lpips | None = None, progress: api.Progress = api.no_progress,
) -> dict[str, Any]:  # fmt: skip
    """Score trajectory, map and uncertainty of a run against its source, and return the metrics written.

    Path and views are scored on the frames whose pose is valid: those of trajectory.txt, without lost frames.
    Training views are keyframes; no map was fitted to held-out views. At most `views_per_kind` of each are scored,
    evenly spread. They are rendered from the final map at the estimated poses and the run's working resolution, with
    `renderer` or the run's render settings. If the run kept its submaps, each view is also rendered from the submap of
    its frame. If the run has uncertainty.json and no `renderer` is given, the predictive variances are scored too. With
    `full_resolution` the views are also scored at the size of the recording, else at that of the final map's last
    stage. Calls `progress(done, total)` with views. With `mesh` the keyframes are fused into mesh.ply, which is scored
    against `true_mesh`, in the world frame of the truth, or the source's true surface, with `random_views` for its
    depth. Raises RunError if the run stopped before it had a map;
    SourceError if truth and run share no timestamps, after everything else has been written.
    """
    frames, field = _read_frames(run), run.read_map()
    records, log = frames.log, frames.posed_log()
    known, scale, path_scores, problem = _score_path(run, frames, source)
    kinds = {kind: [r for r in log if bool(r["is_keyframe"]) == of_map] for kind, of_map in KINDS.items()}
    chosen = {kind: api.evenly_spread(records, views_per_kind) for kind, records in kinds.items()}
    strips, config = ViewStrips(strips_per_kind), run.config()
    fx, path = run_views.refined_fx(config, source.camera), frames.path
    aligned = None if known is None else truth_in_estimate(path.timestamps_s, path.T_world_camera[:, :3, 3], known)
    standard, renderer = renderer is None, renderer or api.FieldRenderer(config.render, config.backend, (field, fx))
    maps, readouts = _map_sources(run, field, records, config.final), frames.readouts(run.facts())
    maps, predictions = (
        _predicting(maps, run, frames, config, fx) if standard else (maps, view_scores.PredictionScores())
    )
    scoring = ViewScoring(source, config.input, maps, chosen, renderer, views_per_kind, aligned, lpips, readouts)
    true = None if source.path_by else known  # an estimate of the device judges nothing
    metrics = _facts(run, source, records, field) | score_states(run, frames, true)
    metrics |= in_metres(path_scores | score_frame_sets(run, frames, true), scale) | {"path_scale": scale}
    if source.path_by and metrics["ate"]:
        metrics |= dict.fromkeys(path_scores) | {"device_path": metrics["ate"] | {"by": source.path_by}}
    failed, to_truth = failure(run, source), None if scale or true is None else scale_to_truth(path, true)
    alarms = failed | wrong_scale(run, source, to_truth)
    metrics |= {"scale_to_truth": to_truth, "failure": "".join(failed).removeprefix("FAILED: "), "alarms": alarms}
    metrics |= _score_views(scoring, config.final, predictions, strips, progress)
    metrics |= {"lpips_network": lpips.net if lpips else None, "reconstruction": None, "reconstruction_published": None}
    metrics["full_resolution"] = run_views.score_full_resolution(scoring, config, full_resolution, progress)
    if mesh:
        surface = None if scale else true_mesh or reconstruct.known_surface(source)  # it is in metres
        how = surface, known, random_views, renderer, progress
        metrics |= reconstruct.fuse_and_score(run, source.camera, *how)
    metrics["pose_covariance"] = score_pose_covariance(run, frames, true)
    metrics["calibration"] = _calibration(run) if standard else None
    metrics["test_views"] = None if scale else run_views.score_test_views(scoring, config.input, strips)
    run.write_metrics(metrics)
    plan = report_plan(run, path, source.camera) if standard else None
    plots = charts.run_charts(frames, _aligned_truth(run, path, known, aligned, known is true))
    write_page(run, metrics, strips.panels, plots, [*alarms] + [str(problem)] * bool(problem), plan, frames)
    if problem:
        raise problem
    return metrics


def _read_frames(run: RunFolder) -> RunFrames:
    """Read the frames of a run. Raises RunError if it has none, or if its log and its path do not match."""
    records, path = run.read_log(), run.read_trajectory()
    if not records:
        raise RunError(f"run {run.path} stopped before its first frame: its log.jsonl is empty; run it again")
    frames = RunFrames.of(records, path)
    if len(path) and not len(frames.rows):
        raise RunError(f"run {run.path}: trajectory.txt and log.jsonl share no timestamps; do they belong to one run?")
    return frames


def _score_path(
    run: RunFolder, frames: RunFrames, source: Source
) -> tuple[Trajectory | None, float | None, dict[str, Any], api.SourceError | None]:
    """Return the true path in the units of the run, None if it shares no timestamps; the run's unit in metres if it is
    arbitrary; and what `score_path` returns."""
    truth = source.truth() if len(frames.rows) else None  # without a valid pose nothing is aligned
    scale = arbitrary_scale(run, frames.path, truth)
    truth = None if truth is None else in_units_of_run(truth, scale)
    odometry = run.read_odometry()
    if odometry is not None:
        odometry = odometry.at(frames.rows[frames.rows < len(odometry)])
    scores, problem = score_path(frames.path, odometry, truth)
    return None if problem else truth, scale, scores, problem


def _map_sources(run: RunFolder, field: GaussianField, records: Log, final: FinalConfig) -> view_scores.MapSources:
    """Return the final map; the submaps, if the run kept those of all its frames and the final map is not an unchanged
    copy of the only one; the poses of the frames in them, and exposures, if the checkpoint has these."""
    count, saved = _submaps(records), dict[str, Tensor]()
    kept = len(run.submaps) == count and (count > 1 or final.seed_from != "submaps" or final.iterations > 0)
    if kept or (run.path / "checkpoint.safetensors").is_file():
        saved = run.read_checkpoint()[0]
    sizes = {"T_world_submap": count * kept, "T_submap_camera": len(records), "exposure": len(records)}
    anchors, poses, exposures = (
        np.asarray(saved[name], np.float64) if 0 < size == len(saved.get(name, ())) else None
        for name, size in sizes.items()
    )
    poses = None if anchors is None else poses
    return view_scores.MapSources(field, run.submaps, anchors, T_submap_camera=poses, exposures=exposures)


def _predicting(
    maps: view_scores.MapSources, run: RunFolder, frames: RunFrames, config: api.Config, fx: float | None
) -> tuple[view_scores.MapSources, view_scores.PredictionScores]:
    """Add the prediction of errors to the maps if the run measured how sure its map is; fx: `refined_fx`. Raises
    RunError if that belongs to another map."""
    field = maps.final
    known = run.uncertainty_of(field)
    if known is None:
        return maps, view_scores.PredictionScores()

    def predict_view(camera: api.Camera, T_camera_world: NDArray[np.float64]) -> api.Predicted:
        options = api.as_refined(config.render, camera, fx)
        return api.predict(field, known, camera, T_camera_world, options, config.backend)

    probes = [row for index in range(len(run.submaps)) for row in run.submaps.load(index).probe_frames]
    calibrated_on = frozenset(frames.log[row]["index"] for row in probes if 0 <= row < len(frames))
    return replace(maps, predict=predict_view), view_scores.PredictionScores(calibrated_on)


def _calibration(run: RunFolder) -> dict[str, Any] | None:
    """Return the number of probe views, the fitted weights and the temperatures of the predicted variances; None if
    not measured."""
    known = run.read_uncertainty()
    if known is None:
        return None
    return {"probes": known.probes} | {name: dict(of) for name, of in vars(known.calibration).items()}


def _submaps(log: Log) -> int:
    """Count submaps; the log of an old version does not name any, which counts as one."""
    return 1 + max(int(record.get("submap", 0)) for record in log)


def _score_views(
    scoring: ViewScoring, final: FinalConfig, predictions: view_scores.PredictionScores, strips: ViewStrips,
    progress: api.Progress,
) -> dict[str, Any]:  # fmt: skip
    """Render the chosen views from the final map and from their submaps; average scores per kind and map; judge V and
    the predictive variances. V is judged on held-out views, or on training views if every frame was mapped.
    """
    chosen, maps = scoring.chosen, scoring.maps
    shown = {
        (kind, r["index"]) for kind, records in chosen.items() for r in api.evenly_spread(records, strips.per_kind)
    }

    def see(view: ScoredView, in_submap: ScoredView | None) -> None:
        predictions.add(view)
        if (view.kind, view.index) in shown:
            strips.add(view)
            if in_submap and view.kind == "held-out":
                strips.add(in_submap, ", in their submaps")

    both = scoring.scores(scoring.input, progress, see)
    judged_on, kept = "held-out" if chosen["held-out"] else "training", maps.T_world_submap is not None
    # σ² of the final map is valid if it was learned during refinement too, or taken over from the submaps.
    keeps_variance = final.uncertainty if final.iterations else final.seed_from == "submaps"
    judged, judged_before = (view_scores.score_uncertainty(found[judged_on].samples, judged_on) for found in both)
    return view_scores.kind_scores(*both, maps) | {
        "uncertainty": judged_before if kept else judged,
        "uncertainty_final": judged if kept and keeps_variance else None,
        "predictive": predictions.scores(),
    }


def _facts(run: RunFolder, source: Source, log: Log, field: GaussianField) -> dict[str, Any]:
    facts, loops = run.facts(), run.read_loops()
    wall_s, finish_s = facts.get("wall_s"), facts.get("finish_s")
    seconds = wall_s or sum(api.frame_seconds(record) for record in log)
    return {
        "source": source.name, "status": facts.get("status"), "frames": len(log),
        "keyframes": sum(bool(record["is_keyframe"]) for record in log),
        "skipped": facts.get("skipped", list(source.skipped)), "splats": len(field), "map_bytes": run.map_bytes(),
        "frames_per_s": len(log) / seconds if seconds else None,
        # The first frame, which creates the map, does not count.
        "worst_frame_s": max(map(api.frame_seconds, log[1:]), default=0.0) or None,
        "submaps": _submaps(log), "onto": (facts.get("onto") or {}).get("run"),
        "loops": {"tried": len(loops), "accepted": sum(bool(loop.get("accepted")) for loop in loops)},
        "finish_s": finish_s, "final_steps": facts.get("final_steps"),
        "total_s": None if wall_s is None or finish_s is None else float(wall_s + finish_s),
    }  # fmt: skip


def _aligned_truth(
    run: RunFolder, path: Trajectory, truth: Trajectory | None, T_estimate_truth: Matrix | None, is_true: bool
) -> Matrix | None:
    """Return the true positions of the valid frames in the world of the run [B, 3], nan if unknown, and write truth.txt
    if it is the truth."""
    (run.path / api.TRUTH).unlink(missing_ok=True)  # of an earlier evaluation
    if truth is None or T_estimate_truth is None:
        return None
    rows, truth_rows = associate(path.timestamps_s, truth.timestamps_s)
    T_world_camera = T_estimate_truth @ truth.T_world_camera[truth_rows]
    if is_true:
        truth = Trajectory(path.timestamps_s[rows], T_world_camera)
        api.write_trajectory(run.path / api.TRUTH, truth)  # for the viewer
    known = np.full((len(path), 3), np.nan)
    known[rows] = T_world_camera[:, :3, 3]
    return known
