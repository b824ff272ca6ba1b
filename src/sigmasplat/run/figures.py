"""Turn figures into text: the headline figures of a run, for the report and for the terminal."""

import math
from typing import Any


def number(value: float | None, digits: int, scale: float = 1.0) -> str:
    """Format a figure with fixed digits and thin spaces between thousands; a dash if it is None, nan or inf."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value * scale:,.{digits}f}".replace(",", "\u202f").replace("-", "−")


def format_ranges(indices: list[int], most: int = 4) -> str:
    """Write increasing indices as at most `most` ranges: 3–5, 9."""
    runs: list[list[int]] = []
    for i in indices:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    words = [str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs[:most]]
    return ", ".join(words) + (", …" if len(runs) > most else "")


def headline(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the headline figures as (name, value, unit), for the top of the page and the table of the command line."""
    held_out, judged = metrics.get("held_out") or {}, metrics.get("uncertainty") or {}
    path = [("ATE RMSE", number(metrics["ate"]["rmse_m"], 2, 100.0), "cm")] if metrics.get("ate") else []
    found = metrics.get("reconstruction")
    surface = [("Surface F1 at 1 cm", number(found["f1"], 1, 100.0), "%")] if found else []
    before = metrics.get("held_out_submaps")
    in_submaps = [("PSNR, held-out, in submaps", number(before.get("psnr_db"), 2), "dB")] if before else []
    test = metrics.get("test_views")
    novel = [("PSNR, novel views", number(test.get("psnr_db"), 2), "dB")] if test else []
    return [
        *path,
        ("PSNR, held-out", number(held_out.get("psnr_db"), 2), "dB"),
        *novel,
        *in_submaps,
        ("Depth L1, held-out", number(held_out.get("depth_l1_m"), 2, 100.0), "cm"),
        *surface,
        *_coverage_figures(metrics),
        (f"Spearman V ~ error²{_if_training(judged)}", number(judged.get("spearman"), 3), ""),
        ("Speed", number(metrics.get("frames_per_s"), 2), "frames/s"),
        ("Longest frame after the first", number(metrics.get("worst_frame_s"), 0, 1e3), "ms"),
        *_total_times(metrics),
        ("Splats", number(metrics.get("splats"), 0), ""),
        ("Map file", number(metrics.get("map_bytes"), 1, 1e-6), "MB"),
        ("Lost frames", number(metrics.get("lost"), 0), f"of {metrics.get('frames', 0)}"),
        *_state_figures(metrics),
        *_submap_figures(metrics),
    ]


def _coverage_figures(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the coverage of the predicted errors, or that there are none; nothing if they were not looked for."""
    found = metrics.get("predictive") or {}
    kinds = (("colour", found.get("color")), ("depth", found.get("depth")))
    known = [
        (f"Within the predicted error, {name}", number(scores["coverage_68"], 0, 100.0), "% (ideal 68)")
        for name, scores in kinds
        if scores
    ]
    if known or "calibration" not in metrics or metrics["calibration"] is not None:
        return known
    return [("Predicted errors", "none", "(uncertainty.probes)")]


def _if_training(judged: dict[str, Any]) -> str:
    """Return words to add to the name of a score of V if no view was held back to judge V on."""
    return ", training views" if judged.get("judged_on") == "training" else ""


def _total_times(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the times of the final map and of the whole run, if known."""
    known = {"Final map": metrics.get("finish_s"), "Frames and final map": metrics.get("total_s")}
    return [(name, number(seconds, 1), "s") for name, seconds in known.items() if seconds is not None]


def _state_figures(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the numbers of frames that were relocalised, are apart, or are silently wrong, if there are any."""
    silent = (metrics.get("failures") or {}).get("silent")
    known = {
        "Relocalised frames": metrics.get("relocalised"),
        "Frames apart": metrics.get("apart"),
        "Silent failures": silent,
    }
    return [(name, number(count, 0), f"of {metrics.get('frames', 0)}") for name, count in known.items() if count]


def _submap_figures(metrics: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the numbers of submaps and loops; nothing for a single submap."""
    if (metrics.get("submaps") or 1) < 2:
        return []
    loops = metrics.get("loops") or {}
    closed = ("Loops closed", number(loops.get("accepted"), 0), f"of {loops.get('tried', 0)} tried")
    return [("Submaps", number(metrics["submaps"], 0), ""), closed]
