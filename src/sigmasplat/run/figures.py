"""Turn figures into text."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sigmasplat.run_folder.run_values import frame_seconds


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


def rate(frames_per_s: float | None) -> str:
    """Write a speed in images per second; below one, as seconds per image."""
    if frames_per_s is None or frames_per_s >= 1.0 or frames_per_s <= 0.0:
        return f"{number(frames_per_s, 1)} images per second"
    return f"{number(1.0 / frames_per_s, 1)} s per image"


STAGES: dict[str, tuple[str, ...]] = {
    "project": ("project",),
    "sort": ("sort",),
    "blend": ("blend",),
    "loss": ("map_loss",),
    "backward": ("blend_backward",),
    "optimiser": ("project_backward",),
    "prepare": ("prepare",),
}
"""Stages that the log measures directly, and the counters that make up each."""


def profile(steps: Sequence[Mapping[str, Any]], wall_s: float) -> dict[str, float]:
    """Sum the seconds of log lines by stage; all stages together give wall_s.

    backward: gradients from pixels to splats; optimiser: gradients from splats to parameters and the Adam step, in one
    pass; align: tracking without its renders; other: seeding, pruning and Python; io: waiting for frames and writing
    the log.
    """
    lines = [step["seconds"] for step in steps]
    total = {stage: sum(line.get(name, 0.0) for line in lines for name in names) for stage, names in STAGES.items()}
    total["align"] = sum(line.get("track", 0.0) - line.get("track_kernels", 0.0) for line in lines)
    inside = sum(map(frame_seconds, steps))
    total["other"] = max(inside - sum(total.values()), 0.0)
    total["io"] = max(wall_s - inside, 0.0)
    return total
