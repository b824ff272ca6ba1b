"""Make the runs of claims.py in this process: a whole run, and what is measured of its maps."""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from claims import Job
from drift_rule import hops_of
from finished_run import FinishedRun
from localise import Search, disturbed
from unseen_views import UnseenView, held_back_views
from weights_runs import VIEWS, mean, registrations, rendered, true_submaps

from sigmasplat.config import Config, RegistrationConfig
from sigmasplat.data import se3
from sigmasplat.fit.pose import fit_pose_adam
from sigmasplat.fit.target import Target
from sigmasplat.graph.registration import LocalisationConfig, tracking_of
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.reconstruction import score_splats
from sigmasplat.plugins.evaluation.metrics.trajectory import align_rigid, associate, score_path
from sigmasplat.plugins.evaluation.metrics.uncertainty import spearman
from sigmasplat.plugins.evaluation.view_scores import ScoredView, sample_pixels, score_uncertainty
from sigmasplat.plugins.sources import open_source
from sigmasplat.system.slam import Slam

Rows = list[dict[str, Any]]
Plateaus = dict[str, tuple[float, int]]
SUBMAPS = "submaps"
SEARCH = Search(off_m=0.02, off_deg=1.0, steps=100, weight_color=0.0)
"""How far held-back frames are moved before they are localised, and the number of steps at most."""
LOCALISED = 6


def rows(job: Job, means: dict[str, str], plateaus: Plateaus) -> Rows:
    """Make a run; return its figures and, for the group of submaps, those of hops, registrations, localisations."""
    torch.set_num_threads(1)
    source, slam = open_source(job.path, job.config().input), Slam(job.config())
    cpu_s = 0.0
    for frame in source:
        start_s = time.process_time()
        slam.step(frame)
        cpu_s += time.process_time() - start_s
    slam.finish()
    done = FinishedRun.of(slam)
    views = held_back_views(done, source, VIEWS)
    figures = path_figures(slam, done, source, views) | {"cpu_s": cpu_s / len(slam.steps)}
    found = [{"group": job.group, "variant": job.variant, "figures": figures}]
    if job.group == SUBMAPS:
        found += hop_ranks(slam, source)
        found += registrations(
            job, slam, true_submaps(slam, source), {name: averaged(job, mean) for name, mean in means.items()}
        )
        found += localisations(job, slam, done, views, plateaus)
    return found


def averaged(job: Job, color_mean: str) -> Config:
    """Return the settings of a run whose registration averages colour errors in this way."""
    config = job.config()
    kind = type("Averaged", (RegistrationConfig,), {"color_mean": color_mean})
    return replace(config, registration=kind(**vars(config.registration)))


def path_figures(slam: Slam, done: FinishedRun, source: Source, views: list[UnseenView]) -> dict[str, Any]:
    """Return the figures of path, views and, if the true surface is known, splats."""
    scores, _ = score_path(done.path.at(done.valid), None, source.truth())
    scored = [seen(done, view) for view in views]
    judged = score_uncertainty([sample_pixels(view) for view in scored]) or {}
    of_views = mean(scored)
    return {
        "ate_m": scores["ate"]["rmse_m"],
        "rpe_m": scores["rpe"]["translation_rmse_m"],
        "rpe_deg": scores["rpe"]["rotation_rmse_deg"],
        "psnr_db": of_views["psnr_db"],
        "depth_l1_m": of_views["depth_l1_m"],
        "spearman": judged.get("spearman"),
        "lost": int((~done.valid).sum()),
        "splats": len(done.field),
        **surface_figures(slam, done, source),
    }


def seen(done: FinishedRun, view: UnseenView) -> ScoredView:
    """Render a view from the submap of its frame."""
    T_camera_submap = se3.inverse(view.T_world_camera) @ done.anchors[view.submap]
    return rendered(done, view, done.store.load(view.submap).field, T_camera_submap)


def surface_figures(slam: Slam, done: FinishedRun, source: Source) -> dict[str, float]:
    """Return the distances between the centres of the splats and the true surface, aligned as for the ATE."""
    surface, truth = source.true_surface(), source.truth()
    if surface is None or truth is None:
        return {}
    own, theirs = associate(done.path.timestamps_s, truth.timestamps_s)
    T_true = truth.T_world_camera[theirs]
    T_truth_world = align_rigid(done.path.T_world_camera[own][:, :3, 3], T_true[:, :3, 3])
    centers = slam.field.means.detach().numpy().astype(np.float64) @ T_truth_world[:3, :3].T + T_truth_world[:3, 3]
    opacities = slam.field.opacities.detach().numpy().astype(np.float64)
    keyframes = np.isin(own, slam.keyframe_indices)
    scores = score_splats(centers, opacities, surface.subdivided(0.2), slam.view.camera, T_true[keyframes])
    return {"splats_chamfer_m": scores["splats_chamfer_m"], "splats_accuracy_m": scores["splats_accuracy_m"],
            "floaters": scores["floaters"]}  # fmt: skip


def hop_ranks(slam: Slam, source: Source) -> Rows:
    """Return the rank correlation of the true errors of hops with what they add to the accumulated covariance."""
    truth = source.truth()
    assert truth is not None, "every sequence of this benchmark has a true path"
    own, theirs = associate(np.array([step.timestamp_s for step in slam.steps]), truth.timestamps_s)
    known = dict(zip(own.tolist(), truth.T_world_camera[theirs], strict=True))
    hops = hops_of(slam, slam.trajectory().T_world_camera, known)["hops"]
    pairs = np.array([(hop["added_m2"], hop["error_m"]) for hop in hops]).reshape(-1, 2)
    rank = float(spearman(*pairs.T)) if len(pairs) > 2 else None
    return [{"group": "hops", "variant": "covariance", "figures": {"rank": rank, "hops": len(pairs)}}]


def localisations(job: Job, slam: Slam, done: FinishedRun, views: list[UnseenView], ways: Plateaus) -> Rows:
    """Localise held-back frames in their submap by the descent of registration; return how far from their tracked
    pose they end, and the number of steps."""
    found, size = Rows(), (slam.view.sums.shape[1], slam.view.sums.shape[2])
    for name, (share, window) in ways.items():
        settings, random = job.config(), np.random.default_rng(job.seed)
        usual, errors_m, steps = tracking_of(settings), [], []
        kind = type("Stopping", (LocalisationConfig,), {"plateau_stop": share, "plateau_window": window})
        tracking = kind(**vars(usual))
        for view in views[:LOCALISED]:
            T_camera_submap = se3.inverse(view.T_world_camera) @ done.anchors[view.submap]
            start = disturbed(T_camera_submap, SEARCH, random)
            params = done.store.load(view.submap).field.params
            fit = fit_pose_adam(params, slam.view, Target.of(view.frame, size), start, tracking, SEARCH.steps)
            apart = se3.inverse(fit.T_camera_world)[:3, 3] - se3.inverse(T_camera_submap)[:3, 3]
            errors_m.append(float(np.linalg.norm(apart)))
            steps.append(fit.iterations)
        figures = {"localised_m": float(np.median(errors_m)), "steps": float(np.mean(steps))}
        found.append({"group": "localisation", "variant": name, "figures": figures})
    return found
