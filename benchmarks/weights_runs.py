"""Make the runs of weights.py: complete runs, and what is measured of the submaps of one run."""

from typing import Any

import numpy as np
import torch
from finished_run import FinishedRun
from numpy.typing import NDArray
from unseen_views import UnseenView, held_back_views
from weights import Job

from sigmasplat.config import Config
from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.final.final_map import final_map
from sigmasplat.final.stores import StorePart
from sigmasplat.graph.candidates import Candidate, SubmapPair, gate
from sigmasplat.graph.closer import LoopCloser
from sigmasplat.graph.localisations import differs
from sigmasplat.graph.registration import Registrar
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import associate, score_path
from sigmasplat.plugins.evaluation.view_scores import ScoredView, scored_view
from sigmasplat.plugins.sources import open_source
from sigmasplat.render import FieldRenderer
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.descriptors import similarity
from sigmasplat.types import completed

Matrix = NDArray[np.float64]
Rows = list[dict[str, Any]]
VIEWS = 24
"""Number of held-back frames that are scored, at most."""
PAIRS = 4
"""Number of pairs of submaps that are registered, at most."""
NEAR_M, NEAR_RAD = 0.7, np.deg2rad(40.0)
"""Keyframes whose true poses are closer than this show the same place."""
START_M, START_RAD = 0.03, np.deg2rad(2.0)
"""Standard deviation, per axis, of the error of the pose that registration starts from."""


def run(job: Job) -> tuple[Slam, Source]:
    """Run SLAM on a job's sequence, including the final map."""
    torch.set_num_threads(1)
    config = job.config()
    source, slam = open_source(job.path, config.input), Slam(config)
    for frame in source:
        slam.step(frame)
    slam.finish()
    return slam, source


def rows(job: Job, weights: dict[str, tuple[str, ...]]) -> Rows:
    """Make a complete run; return its figures, and those of its registrations, loop gate and final maps by weight."""
    slam, source = run(job)
    done = FinishedRun.of(slam)
    views = held_back_views(done, source, VIEWS)
    found = [{"group": "path", "variant": job.variant, "figures": path_figures(slam, done, source, views)}]
    if not weights:
        return found
    truth = true_submaps(slam, source)
    found += final_maps(job, slam, done, views, weights)
    found += registrations(job, slam, truth, {name: job.config(settings) for name, settings in weights.items()})
    return found + gates(job, slam, truth, weights)


def path_figures(slam: Slam, done: FinishedRun, source: Source, views: list[UnseenView]) -> dict[str, Any]:
    """Return the figures of path, submaps and final map."""
    scores, _ = score_path(done.path.at(done.valid), None, source.truth())
    final, before = view_scores(done, views, done.field), submap_scores(done, views)
    return {
        "ate_m": scores["ate"]["rmse_m"],
        "rpe_m": scores["rpe"]["translation_rmse_m"],
        "rpe_deg": scores["rpe"]["rotation_rmse_deg"],
        "psnr_before_db": before["psnr_db"],
        "depth_l1_before_m": before["depth_l1_m"],
        "psnr_db": final["psnr_db"],
        "depth_l1_m": final["depth_l1_m"],
        "lost": int((~done.valid).sum()),
        "loops": sum(loop.accepted for loop in slam.loops),
        "loops_tried": len(slam.loops),
        "splats": len(done.field),
        "submaps": len(done.anchors),
    }


def view_scores(done: FinishedRun, views: list[UnseenView], field: GaussianField) -> dict[str, float]:
    """Return the mean scores of a map in the world at views."""
    return mean([rendered(done, view, field, se3.inverse(view.T_world_camera)) for view in views])


def submap_scores(done: FinishedRun, views: list[UnseenView]) -> dict[str, float]:
    """Return the mean scores of views rendered from the submap of their frame."""
    return mean([
        rendered(
            done, view, done.store.load(view.submap).field,
            se3.inverse(view.T_submap_camera),
        )
        for view in views
    ])  # fmt: skip


def rendered(done: FinishedRun, view: UnseenView, field: GaussianField, T_camera_map: Matrix) -> ScoredView:
    """Render a map at a view."""
    with torch.no_grad():
        seen = FieldRenderer(done.config.render, done.config.backend)(field, view.frame.camera, T_camera_map)
    return scored_view(view.frame, seen, "held-out")


def mean(views: list[ScoredView]) -> dict[str, float]:
    """Return the mean of each score."""
    scores = [view.scores() for view in views]
    return {name: float(np.nanmean([score[name] for score in scores])) for name in scores[0]}


# ---- the submaps of one run ----


def final_maps(
    job: Job, slam: Slam, done: FinishedRun, views: list[UnseenView], weights: dict[str, tuple[str, ...]]
) -> Rows:
    """Make the final map of a run with each weight; return its scores at the held-back views."""
    found, members = Rows(), done.members
    for name in (name for name in weights if "τ" not in name):  # merging has no τ
        random, store = np.random.default_rng(job.seed), StorePart(done.store, members)
        anchors = [done.anchors[s] for s in members]
        field = final_map(store, anchors, job.config(weights[name]), slam.view, random).field
        scores = view_scores(done, views, field)
        figures = {"psnr_db": scores["psnr_db"], "depth_l1_m": scores["depth_l1_m"], "splats": len(field)}
        found.append({"group": "final", "variant": name, "figures": figures})
    return found


def true_submaps(slam: Slam, source: Source) -> list[Matrix]:
    """Return the true poses T_world_keyframe [K, 4, 4] of the keyframes of each submap; nan if not known."""
    truth, path = source.truth(), slam.trajectory()
    assert truth is not None, "every sequence of this benchmark has a true path"
    known = np.full((len(path), 4, 4), np.nan)
    rows, at = associate(path.timestamps_s, truth.timestamps_s)
    known[rows] = truth.T_world_camera[at]
    return [known[list(slam.store.load(s).frames)] for s in range(len(slam.store))]


def pairs_of(truth: list[Matrix]) -> list[tuple[float, int, int, tuple[int, ...], tuple[int, ...]]]:
    """List pairs of submaps that show the same place, nearest first, and the two nearest keyframes of each side.

    The keyframe that a submap shares with the next one is left out.
    """
    found = []
    for i in range(len(truth)):
        for j in range(i + 1, len(truth)):
            ours, theirs = truth[i][:-1] if j == i + 1 else truth[i], truth[j][1:] if j == i + 1 else truth[j]
            if len(ours) < 2 or len(theirs) < 2:
                continue
            apart_m, apart_rad = apart(ours, theirs)
            far = apart_m / NEAR_M + apart_rad / NEAR_RAD
            if np.nanmin(far) < 1.0:
                q = tuple(int(k) for k in np.argsort(np.nanmin(far, 1), kind="stable")[:2])
                d = tuple(int(k) + (j == i + 1) for k in np.argsort(np.nanmin(far, 0), kind="stable")[:2])
                found.append((float(np.nanmin(far)), i, j, q, d))
    return sorted(found)


def apart(ours: Matrix, theirs: Matrix) -> tuple[Matrix, Matrix]:
    """Return the distance [m] and the angle [rad] between all poses of two lists, [A, B] each."""
    cosine = (np.einsum("aij,bij->ab", ours[:, :3, :3], theirs[:, :3, :3]) - 1.0) / 2.0
    distance_m = np.linalg.norm(ours[:, None, :3, 3] - theirs[None, :, :3, 3], axis=-1)
    return distance_m, np.arccos(np.clip(cosine, -1.0, 1.0))


def registrations(job: Job, slam: Slam, truth: list[Matrix], ways: dict[str, Config]) -> Rows:
    """Register pairs of submaps from poses with errors; return the error of each way's results where all ways
    accept."""
    chosen = pairs_of(truth)
    chosen = [chosen[int(k)] for k in np.unique(np.linspace(0, len(chosen) - 1, min(PAIRS, len(chosen))).round())]
    random = np.random.default_rng(job.seed)
    starts = [se3.exp(random.normal(size=6) * np.repeat([START_M, START_RAD], 3)) for _ in chosen]
    errors: dict[str, list[tuple[float, float] | None]] = {}
    for name, config in ways.items():
        registrar = Registrar(config, slam.store, slam.view, slam.tracker.extractor)
        errors[name] = []
        for (_, i, j, q, d), start in zip(chosen, starts, strict=True):
            a, b = slam.store.load(i), slam.store.load(j)
            T_a_b = se3.inverse(truth[i][0]) @ truth[j][0]
            pair = SubmapPair(Candidate(i, q[0], j, d[0], 1.0, 1.0), q, d)
            result = completed(registrar.register(pair, a, b, T_a_b @ start))
            off = differs(result.T_a_b, T_a_b, b.T_submap_camera[d[0]][:3, 3])
            errors[name].append(off if result.accepted else None)
    common = [k for k in range(len(chosen)) if all(found[k] is not None for found in errors.values())]
    listed = Rows()
    for name, found in errors.items():
        kept = np.array([found[k] for k in common], np.float64).reshape(-1, 2)
        figures = {
            "registration_m": float(np.sqrt((kept[:, 0] ** 2).mean())) if len(kept) else None,
            "registration_deg": float(np.degrees(np.sqrt((kept[:, 1] ** 2).mean()))) if len(kept) else None,
            "accepted": sum(error is not None for error in found),
            "pairs": len(chosen),
        }
        listed.append({"group": "registration", "variant": name, "figures": figures})
    return listed


def gates(job: Job, slam: Slam, truth: list[Matrix], weights: dict[str, tuple[str, ...]]) -> Rows:
    """Return the average precision with which similarity × gate finds keyframes that show the same place."""
    found = Rows()
    for name, settings in weights.items():
        closer = LoopCloser(job.config(settings), slam.store)
        figures = {"average_precision": gate_precision(closer, slam, truth)}
        found.append({"group": "gate", "variant": name, "figures": figures})
    return found


def gate_precision(closer: LoopCloser, slam: Slam, truth: list[Matrix]) -> float | None:
    """Return the average precision over all pairs of keyframes of submaps that may be a loop; None without both
    kinds of pairs."""
    described, ratios = slam.closer.descriptors, [1.0] * len(slam.closer.descriptors)
    if closer.config.loops.uncertainty:
        ratios = [closer.opacity_ratio(slam.store.load(d.index)) for d in described]
    scores, labels = list[Matrix](), list[NDArray[np.bool_]]()
    for i, query in enumerate(described):
        for j in range(max(0, i + 1 - closer.config.loops.min_interval)):
            other = described[j]
            apart_m, apart_rad = apart(truth[query.index], truth[other.index])
            near = (apart_m < 2 * NEAR_M) & (apart_rad < NEAR_RAD)
            scores.append((similarity(query.descriptors, other.descriptors) * gate(ratios[i], ratios[j])).ravel())
            labels.append(near.ravel())
    if not labels:
        return None
    score, label = np.concatenate(scores), np.concatenate(labels)
    return average_precision(score, label) if 0 < label.sum() < len(label) else None


def average_precision(scores: NDArray[np.floating], labels: NDArray[np.bool_]) -> float:
    """Return the mean precision at each true pair, pairs ordered by falling score."""
    ordered = labels[np.argsort(-scores, kind="stable")]
    precision = np.cumsum(ordered) / np.arange(1, len(ordered) + 1)
    return float(precision[ordered].mean())
