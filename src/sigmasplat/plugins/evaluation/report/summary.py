"""Describe the scores of a run in sentences: what was made, how good it is, where to scan again, what to try next."""

from typing import TYPE_CHECKING, Any

from sigmasplat.plugins.outputs.floorplan.rescan import unsure_rule
from sigmasplat.run.figures import format_ranges, number

if TYPE_CHECKING:
    from sigmasplat.plugins.outputs.floorplan.floor_plan import FloorPlan

Metrics = dict[str, Any]
Advice = tuple[str, str]
"""What was found and what it means, and a command to try; the command may be empty."""

PSNR_WORDS = ((30.0, "very close to the camera images"), (25.0, "good"), (20.0, "recognisable, fine detail is blurred"))
RANK_WORDS = ((0.5, "well"), (0.3, "fairly well"), (0.1, "weakly"))
DEPTH_WORDS = ((0.01, "very accurate"), (0.03, "good"))
OVERFIT_DB = 3.0
"""If training views are better than held-out views by this much, there are too few keyframes."""
NOMINAL, CALIBRATED = 0.683, 0.05
"""Coverage of one standard deviation, and the largest difference from it that counts as calibrated."""
SLOW_PER_S = 5.0
"""Below this number of images per second a run is slow."""


def summary_sentences(metrics: Metrics, machine: str = "") -> list[str]:
    """Return sentences about the whole run, the most important first."""
    return [
        _overview(metrics, machine),
        _path(metrics),
        *_images(metrics),
        *_depth(metrics),
        *_uncertainty(metrics),
        *_predicted_errors(metrics),
        *_pose_covariance(metrics),
    ]


def _overview(metrics: Metrics, machine: str) -> str:
    speed = metrics.get("frames_per_s")
    how = f" at {number(speed, 1)} images per second" if speed else ""
    status = metrics.get("status")
    unfinished = (
        "" if status in (None, "complete") else f" The run is {status}: this report covers the frames up to that point."
    )
    return (
        f"SigmaSplat made a camera path and a map of {number(metrics.get('splats'), 0)} splats from "
        f"{number(metrics.get('frames'), 0)} colour and depth images of {metrics.get('source')}{how}"
        f"{f' on {machine}' if machine else ''}.{_continued(metrics)}{unfinished}"
    )


def _continued(metrics: Metrics) -> str:
    """Return whether the run is connected to the map of the earlier run that it continues."""
    if not metrics.get("onto"):
        return ""
    if not metrics.get("believed"):
        return f" It was never recognised in the map of {metrics['onto']}, so all of it is in components/."
    return f" It continues the map of {metrics['onto']}: poses are in the world of that run."


def _path(metrics: Metrics) -> str:
    lost, ate = metrics.get("lost") or 0, metrics.get("ate") or {}
    tracked = (
        f"Tracking was lost on {lost} of {metrics.get('frames')} images, which have no pose."
        if lost
        else "Tracking was never lost."
    )
    tracked += _apart_sentence(metrics)
    if ate.get("rmse_m") is None:
        return f"{tracked} The error of the path is unknown, because the recording has no ground truth."
    before = (metrics.get("ate_odometry") or {}).get("rmse_m")
    differs = before is not None and abs(before - ate["rmse_m"]) > max(0.1 * ate["rmse_m"], 1e-3)
    loops = f" Without loop closure the RMS error is {number(before, 1, 100.0)} cm." if differs else ""
    error, largest = number(ate["rmse_m"], 1, 100.0), number(ate.get("max_m"), 1, 100.0)
    silent = (metrics.get("failures") or {}).get("silent") or 0
    undeclared = f" {silent} poses are off by more than 10 cm, but were not reported as lost." if silent else ""
    factor = metrics.get("path_scale")
    aligned = f" The scale is arbitrary: the path is aligned with scale factor {number(factor, 2)}." if factor else ""
    return (
        f"{tracked} The RMS error of the path is {error} cm; the largest error is {largest} cm."
        f"{aligned}{undeclared}{loops}"
    )


def _apart_sentence(metrics: Metrics) -> str:
    apart, components = metrics.get("apart") or 0, len(metrics.get("components") or [])
    if not apart:
        return ""
    maps = "a map of their own" if components == 1 else f"{components} maps of their own"
    return f" {apart} images are in {maps}, which could not be connected to the first one (components/)."


def _images(metrics: Metrics) -> list[str]:
    psnr_db = (metrics.get("held_out") or {}).get("psnr_db")
    if psnr_db is None:
        return []
    rating = next((words for least, words in PSNR_WORDS if psnr_db >= least), "poor")
    return [f"Rendered images of held-out frames reach {number(psnr_db, 1)} dB PSNR: {rating}."]


def _depth(metrics: Metrics) -> list[str]:
    held_out = metrics.get("held_out") or {}
    if held_out.get("depth_l1_m") is None:
        return []
    holes = 1.0 - (held_out.get("depth_coverage") or 0.0)
    missing = f" {number(holes, 0, 100.0)} % of the depth readings have no surface in the map." if holes > 0.02 else ""
    error_m = held_out["depth_l1_m"]
    rating = next((words for most, words in DEPTH_WORDS if error_m <= most), "coarse")
    return [
        f"The depth of the map differs from the measured depth by {number(error_m, 1, 100.0)} cm on average: {rating}."
        f"{missing}"
    ]


def _uncertainty(metrics: Metrics) -> list[str]:
    judged = metrics.get("uncertainty") or {}
    rank = judged.get("spearman")
    if rank is None:
        return []
    rating = next(
        (f"V predicts {words} where" for least, words in RANK_WORDS if rank >= least), "V does not show where"
    )
    views = " at training views, because no view was held back" if judged.get("judged_on") == "training" else ""
    return [f"The uncertainty {rating} the rendered colours are wrong{views} (rank correlation {number(rank, 2)})."]


def _predicted_errors(metrics: Metrics) -> list[str]:
    found = metrics.get("predictive") or {}
    measured = {name: found[key] for key, name in (("color", "colour"), ("depth", "depth")) if found.get(key)}
    if not measured:
        return _unknown_errors(metrics)
    shares = ", ".join(f"{number(of['coverage_68'], 0, 100.0)} % ({name})" for name, of in measured.items())
    verdicts = [_verdict(name, of) for name, of in measured.items()]
    return [
        f"{_calibrated_on(metrics)}68 % of the errors should be within one predicted standard deviation: measured "
        f"{shares}. {' '.join(verdicts)}"
    ]


def _calibrated_on(metrics: Metrics) -> str:
    probes = (metrics.get("calibration") or {}).get("probes")
    if probes is None:
        return ""
    if not probes:
        return "The run kept no probe view, so predicted errors have the weights of the preset. "
    return f"Predicted errors were calibrated on {probes} probe views, to which no map was fitted. "


def _verdict(name: str, scores: Metrics) -> str:
    """Return whether a predicted error has the right size, and the factor that corrects it."""
    off = scores["coverage_68"] - NOMINAL
    if abs(off) <= CALIBRATED:
        return f"The predicted error of {name} has the right size."
    size, factor = "small" if off < 0 else "large", scores.get("z_68")
    correction = "" if factor is None else f"; multiply it by {number(factor, 2)}"
    return f"The predicted error of {name} is too {size}{correction}."


def _unknown_errors(metrics: Metrics) -> list[str]:
    if "calibration" not in metrics or metrics["calibration"] is not None:
        return []
    return ["The run has no predicted errors of colour and depth: the size of V is not calibrated."]


def _pose_covariance(metrics: Metrics) -> list[str]:
    covariance = metrics.get("pose_covariance") or {}
    found = covariance.get("windows")
    if not found:
        return []
    return [
        f"90 % of the position errors over {covariance['window_frames']} frames should be within the covariance of the "
        f"poses: measured {number(found['position_coverage_90'], 0, 100.0)} %."
    ]


def rescan_sentences(metrics: Metrics, plan: "FloorPlan | None") -> list[str]:
    """Return sentences about what the map lacks: lost frames, frames apart, and regions of the plan."""
    sentences = []
    lost = metrics.get("lost_frames") or []
    if lost:
        sentences.append(f"Tracking was lost at images {format_ranges(lost)}: they are not in the map.")
    if apart := metrics.get("apart_frames"):
        sentences.append(f"Images {format_ranges(apart)} are not connected to the map, so they are not in the plan.")
    if plan is None:
        return sentences
    reasons = {"unseen": "not observed", "thin": "mapped too thinly", "unsure": "mapped with high uncertainty"}
    areas = {why: [region.area_m2 for region in plan.regions if region.why == why] for why in reasons}
    parts = [f"{len(found)} {reasons[why]} ({number(sum(found), 1)} m²)" for why, found in areas.items() if found]
    if parts:
        sentences.append(f"Regions near the path to scan again: {', '.join(parts)}.")
    return [*sentences, unsure_rule(plan.predicted_errors)]


def advice(metrics: Metrics, run: str, again: str, settings: dict[str, Any]) -> list[Advice]:
    """Return what to try next.

    run: the run folder; again: the command that makes the run again; settings: the values of its config.json.
    """
    found = [rule(metrics, again, settings) for rule in RULES]
    view = ("View the map in 3D, and hide uncertain splats:", f"sigmasplat view {run}")
    mesh = ("Export a mesh for other programs:", f"sigmasplat mesh {run} --out room.glb")
    return [*filter(None, found), view, mesh]


def _lost(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if not metrics.get("lost"):
        return None
    stride = (settings.get("input") or {}).get("stride", 1)
    if stride > 1:
        words = f"Tracking was lost, and the run used one image in {stride}. Use all images:"
        return words, f"{again} --stride 1"
    tracking = settings.get("tracking") or {}
    if not tracking.get("features", True):
        words = "Tracking was lost, and sparse features are off. They help where the camera moves fast:"
        return words, f"{again} --set tracking.features=true"
    every = max((settings.get("mapping") or {}).get("every", 1) // 2, 1)
    return (
        "Tracking was lost: the camera moved too fast, or saw only a bare wall. Map more often; if this does not help, "
        "record that part again and move more slowly.",
        f"{again} --set mapping.every={every}",
    )


def _apart(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if not metrics.get("apart"):
        return None
    where = format_ranges(metrics.get("apart_frames") or [])
    return (
        f"Images {where} are in separate maps, in components/. To connect them, record again, and after each "
        "interruption return to a place that was recorded before.",
        "",
    )


def _few_keyframes(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    training, held_out = (((metrics.get(kind) or {}).get("psnr_db")) for kind in ("training", "held_out"))
    every = (settings.get("mapping") or {}).get("every", 1)
    if training is None or held_out is None or training - held_out < OVERFIT_DB or every < 2:
        return None
    return (
        f"Training views are {number(training - held_out, 1)} dB better than held-out views. Use more keyframes:",
        f"{again} --set mapping.every={every // 2}",
    )


def _blurred(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    psnr_db = (metrics.get("held_out") or {}).get("psnr_db")
    width = (settings.get("input") or {}).get("width", 0)
    if psnr_db is None or psnr_db >= PSNR_WORDS[1][0] or not width:
        return None
    return (
        f"Rendered images are blurred. The map was made from images {width} pixels wide; larger images give a sharper "
        "map, but take longer:",
        f"{again} --set input.width={2 * width}",
    )


def _holes(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    covered = (metrics.get("held_out") or {}).get("depth_coverage")
    if covered is None or covered > 0.9:
        return None
    missing = number(1 - covered, 0, 100.0)
    return f"{missing} % of the depth readings have no surface in the map. Scan these places again, more slowly.", ""


def _slow(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    speed, width = metrics.get("frames_per_s"), (settings.get("input") or {}).get("width", 0)
    finish_s = metrics.get("finish_s") or 0.0
    if speed and finish_s > (frames_s := metrics["frames"] / speed):
        return _slow_to_finish(metrics["frames"], frames_s, finish_s, again, settings)
    if not speed or speed >= SLOW_PER_S:
        return None
    smaller = max((width or 640) * 3 // 4 // 16 * 16, 160)
    return (
        f"The run is slow: {number(speed, 1)} images per second. Smaller images are faster:",
        f"{again} --set input.width={smaller}",
    )


def _slow_to_finish(
    frames: int, frames_s: float, finish_s: float, again: str, settings: dict[str, Any]
) -> Advice | None:
    """Advise fewer iterations of the final map if it took longer than all frames, and the run was slow in total."""
    steps = (settings.get("final") or {}).get("iterations", 0)
    if steps < 2 or frames / (frames_s + finish_s) >= SLOW_PER_S:
        return None
    return (
        f"The final map took {number(finish_s, 0)} s, all frames took {number(frames_s, 0)} s. "
        "Fewer iterations are faster:",
        f"{again} --set final.iterations={steps // 2}",
    )


def _no_loop(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if (metrics.get("submaps") or 1) < 3 or (metrics.get("loops") or {}).get("accepted"):
        return None
    return "No loop was closed, so drift could not be corrected. End a scan where it started.", ""


def _no_prediction(metrics: Metrics, again: str, settings: dict[str, Any]) -> Advice | None:
    if "calibration" not in metrics or metrics["calibration"] is not None:
        return None
    if (settings.get("uncertainty") or {}).get("probes"):
        return "The run has no predicted errors, because it did not make its final map. Make it again:", again
    return (
        "The run has no predicted errors of colour and depth, because it kept no probe views. Keep four in each "
        "submap; this does not change the map:",
        f"{again} --set uncertainty.probes=4",
    )


RULES = (_lost, _apart, _few_keyframes, _blurred, _holes, _slow, _no_loop, _no_prediction)
"""What to check, the most important first."""
