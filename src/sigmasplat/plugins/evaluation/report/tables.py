"""Turn metrics into rows of text: the key figures, and the tables of the report, whose first row is the head."""

from collections.abc import Mapping, Sequence
from typing import Any

from sigmasplat.api import APART, LOST, RELOCALISED, TRACKED, format_ranges, number, rate
from sigmasplat.plugins.evaluation.path_scores import MOTIONS


def key_figures(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the figures that the terminal shows, as (name, value, unit); at most six."""
    views = next((kind for kind in ("held_out", "training") if metrics.get(kind)), "held_out")
    scores, kind = metrics.get(views) or {}, views.replace("_", "-")
    frames = metrics.get("frames") or 0
    posed = frames - (metrics.get("lost") or 0) - (metrics.get("apart") or 0)
    ate = metrics.get("device_path") or metrics.get("ate") or {}
    name = "Difference to the device's path" if "by" in ate else "ATE RMSE"
    path = [(name, number(ate["rmse_m"], 2, 100.0), "cm")] if ate else []
    speed, unit = rate(metrics.get("frames_per_s")).split(" ", 1)
    figures = [
        ("Images with a pose", number(posed, 0), f"of {frames}"), *path,
        (f"PSNR, {kind} images", number(scores.get("psnr_db"), 2), "dB"),
        (f"Depth L1, {kind} images", number(scores.get("depth_l1_m"), 2, 100.0), "cm"), ("Speed", speed, unit),
        ("Map", number(metrics.get("splats"), 0), f"splats, {number(metrics.get('map_bytes'), 1, 1e-6)} MB"),
    ]  # fmt: skip
    return [figures[0], *figures[-2:]] if metrics.get("failure") else figures


def state_rows(metrics: dict[str, Any]) -> list[list[str]]:
    """Return one row per state that occurs: number of frames, share, and which frames."""
    frames = metrics.get("frames") or 0
    listed = {state: metrics.get(f"{state}_frames") or [] for state in (RELOCALISED, LOST, APART)}
    counts = [(TRACKED, frames - sum(map(len, listed.values())), "")]
    counts += [(state, len(found), format_ranges(found)) for state, found in listed.items() if found]
    return [["state", "frames", "%", "which"]] + [
        [state, number(count, 0), number(count / max(frames, 1), 1, 100.0), where] for state, count, where in counts
    ]


Lines = Sequence[tuple[str, str, int, float]]
"""Of a table: label, key of the figure, digits, and the factor that brings it to the unit of the label."""


def figure_rows(lines: Lines, *columns: Mapping[str, Any]) -> list[list[str]]:
    """Return a row for each line, with its figure in each column; a dash where it is not known."""
    return [[label, *(number(of.get(key), digits, factor) for of in columns)] for label, key, digits, factor in lines]


def score_tables(metrics: dict[str, Any]) -> list[tuple[str, list[list[str]]]]:
    """Return the tables of scores with their titles. A table without figures has at most a head."""
    kind = (metrics.get("uncertainty") or {}).get("judged_on", "held-out")
    sharp = (metrics.get("full_resolution") or {}) and metrics["full_resolution"] | {
        "lpips_network": metrics.get("lpips_network")
    }
    views = f"{kind}, in submaps" if metrics.get("held_out_submaps") else kind
    return [
        ("Run", _run_rows(metrics)),
        ("Rendered images", _image_rows(metrics)),
        ("Rendered images, full resolution: {width} × {height}".format(**sharp), _image_rows(sharp))
        if sharp
        else ("", []),
        ("Path", _path_rows(metrics)),
        ("Surface", _column(metrics, "reconstruction", RUN_SURFACE)),
        ("Surface, by the protocol of published systems", _column(metrics, "reconstruction_published", PUBLISHED)),
        (f"Uncertainty V, {views}", _column(metrics, "uncertainty", UNCERTAINTY)),
        (f"Uncertainty V, {kind}, final map", _column(metrics, "uncertainty_final", UNCERTAINTY)),
        ("Predicted errors, held-out, final map", _predictive_rows(metrics.get("predictive"))),
        ("Covariance of poses", _covariance_rows(metrics.get("pose_covariance"))),
    ]


def _run_rows(metrics: dict[str, Any]) -> list[list[str]]:
    lines = [("Speed", "frames_per_s", 2, 1.0, "frames/s"),
             ("Longest frame after the first", "worst_frame_s", 0, 1e3, "ms"),
             ("Final map", "finish_s", 1, 1.0, "s"), ("Frames and final map", "total_s", 1, 1.0, "s"),
             ("Splats", "splats", 0, 1.0, ""), ("Map file", "map_bytes", 1, 1e-6, "MB")]  # fmt: skip
    loops, submaps = metrics.get("loops") or {}, metrics.get("submaps") or 1
    closed = f"{submaps}; {loops.get('accepted', 0)} of {loops.get('tried', 0)}"
    known = [line for line in lines if metrics.get(line[1]) is not None]
    figures = [[name, f"{number(metrics[key], digits, scale)} {unit}"] for name, key, digits, scale, unit in known]
    return [["size and time", ""], *figures, *[["Submaps; loops accepted", closed]] * (submaps > 1)]


def _image_rows(metrics: dict[str, Any]) -> list[list[str]]:
    columns = {"training": "training", "held-out": "held_out"}
    if metrics.get("test_views"):
        columns |= {"novel views": "test_views"}
    if metrics.get("training_submaps") or metrics.get("held_out_submaps"):
        columns |= {"training, in submaps": "training_submaps", "held-out, in submaps": "held_out_submaps"}
    kinds = [metrics.get(key) or {} for key in columns.values()]
    lines = [("Views", "views", 0, 1.0), ("PSNR, dB", "psnr_db", 2, 1.0), ("SSIM", "ssim", 4, 1.0),
             ("Depth L1, cm", "depth_l1_m", 2, 100.0), ("Depth covered, %", "depth_coverage", 1, 100.0),
             ("PSNR, all pixels, dB", "psnr_image_db", 2, 1.0), ("MS-SSIM, all pixels", "ms_ssim", 4, 1.0)]  # fmt: skip
    network = metrics.get("lpips_network")
    lines.append((f"LPIPS ({network or 'no weights'}), all pixels", "lpips", 4, 1.0))
    return [["", *columns], *figure_rows(lines, *kinds)]


def _path_rows(metrics: dict[str, Any]) -> list[list[str]]:
    ate, rpe = metrics.get("ate"), metrics.get("rpe")
    if not ate or not rpe:
        return []
    rows = figure_rows([(f"ATE {kind}, cm", f"{kind}_m", 3, 100.0) for kind in ("rmse", "mean", "median", "max")], ate)
    kinds = {"keyframes": metrics.get("ate_keyframes"), "all frames, with lost ones": metrics.get("ate_all_frames")}
    for kind, found in kinds.items():
        if found and found["pairs"] != ate["pairs"]:
            rows.append([f"ATE rmse of {kind} ({found['pairs']} poses), cm", number(found["rmse_m"], 3, 100.0)])
    if without := metrics.get("ate_odometry"):
        rows.append(["ATE rmse without loop closure, cm", number(without["rmse_m"], 3, 100.0)])
    rows += figure_rows(RELATIVE, rpe)
    if failures := metrics.get("failures"):
        off = f"{number(failures['off'], 0)} of {number(failures['frames'], 0)}"
        silent, *others = figure_rows(FAILURES, failures)
        rows += [silent, ["frames off by > 5 cm, with lost ones", off], *others]
    factor = metrics.get("path_scale")
    alignment = f"aligned with scale factor {number(factor, 3)}" if factor else "rigid alignment"
    return [[f"valid frames, {alignment}", f"{ate['pairs']} poses"], *rows]


RELATIVE = (
    ("RPE translation, cm per frame", "translation_rmse_m", 3, 100.0),
    ("RPE rotation, ° per frame", "rotation_rmse_deg", 3, 1.0),
)
FAILURES = (
    ("silent failures: valid, but off by > 10 cm", "silent", 0, 1.0),
    ("AUROC of the probability of > 5 cm", "auroc", 3, 1.0), ("Brier score of it", "brier", 4, 1.0),
)  # fmt: skip
"""How honest the run is about its path: silent failures, and scores of the predicted probability."""
SURFACE = (
    ("Accuracy, cm", "accuracy_m", 2, 100.0), ("Completion, cm", "completion_m", 2, 100.0),
    ("Completion ratio (< 5 cm), %", "completion_ratio", 1, 100.0), ("Precision (< 1 cm), %", "precision", 1, 100.0),
    ("Recall (< 1 cm), %", "recall", 1, 100.0), ("F1 (1 cm), %", "f1", 1, 100.0),
)  # fmt: skip


RUN_SURFACE = "parts visible from keyframes", "mesh.ply, map.ply", "", (
    *SURFACE, ("Splats to surface, cm", "splats_accuracy_m", 2, 100.0),
    ("Surface to splats, cm", "splats_completion_m", 2, 100.0),
    ("Chamfer distance of splats, cm", "splats_chamfer_m", 2, 100.0),
    ("Floaters (> 10 cm) among opaque splats, %", "floaters", 2, 100.0),
)  # fmt: skip
PUBLISHED = "points on both surfaces", "{} random views", "depth_views", (
    *SURFACE, ("Chamfer distance, cm", "chamfer_m", 2, 100.0), ("Depth L1, random views, cm", "depth_l1_m", 2, 100.0),
)  # fmt: skip
UNCERTAINTY = "pixels with a depth reading", "{} pixels", "pixels", (
    ("Spearman of V and squared error", "spearman", 3, 1.0),
    ("Spearman, only covered pixels", "spearman_covered", 3, 1.0), ("AUSE (0 = perfect ranking)", "ause", 3, 1.0),
    ("Gaussian NLL", "nll", 3, 1.0), ("mean V, 10⁻³", "mean_variance", 3, 1e3),
    ("mean squared error, 10⁻³", "mean_squared_error", 3, 1e3),
)  # fmt: skip
"""Tables of one column: both parts of the head, the key of the number in it, and the lines."""


def _column(metrics: dict[str, Any], key: str, table: tuple[str, str, str, Lines]) -> list[list[str]]:
    """Return such a table of the scores under a key of the metrics; [] without them."""
    (left, right, counted, lines), found = table, metrics.get(key)
    return [[left, right.format(number(found.get(counted), 0))], *figure_rows(lines, found)] if found else []


def _predictive_rows(scores: dict[str, Any] | None) -> list[list[str]]:
    if not scores:
        return []
    lines = [("Pixels", "pixels", 0, 1.0), ("Within 1 standard deviation, % (ideal 68)", "coverage_68", 1, 100.0),
             ("Within 1.96 standard deviations, % (95)", "coverage_95", 1, 100.0),
             ("Factor that makes it 68 % (ideal 1)", "z_68", 2, 1.0),
             ("AUCE (0 = right size)", "auce", 3, 1.0), ("AUSE (0 = perfect ranking)", "ause", 3, 1.0),
             ("Spearman of variance and squared error", "spearman", 3, 1.0),
             ("Gaussian NLL", "nll", 3, 1.0)]  # fmt: skip
    kinds = [scores.get(key) or {} for key in ("color", "depth")]
    return [[f"{scores['views']} views", "colour", "depth"], *figure_rows(lines, *kinds)]


def _covariance_rows(scores: dict[str, Any] | None) -> list[list[str]]:
    kinds = {name: found for key, name in MOTIONS.items() if (found := (scores or {}).get(key))}
    if not kinds:
        return []
    own = "… with the truth's own error"
    lines = [("Motions", "count", 0, 1.0), ("Poses in their 90 % ellipsoid, %", "coverage_90", 1, 100.0),
             (own, "coverage_90_with_truth", 1, 100.0),
             ("Positions in their 90 % ellipsoid, %", "position_coverage_90", 1, 100.0),
             (own, "position_coverage_90_with_truth", 1, 100.0),
             ("NEES, mean (ideal 6)", "nees_mean", 2, 1.0),
             ("k of the position (ideal 1)", "position_k", 2, 1.0),
             (own, "position_k_with_truth", 2, 1.0)]  # fmt: skip
    lines = [line for line in lines if any(line[1] in found for found in kinds.values())]
    return [["", *kinds], *figure_rows(lines, *kinds.values())]
