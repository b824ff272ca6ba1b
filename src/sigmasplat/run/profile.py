"""Sum a run's time by stage: kernels, loss, optimiser, alignment, input and the rest."""

from collections.abc import Mapping, Sequence
from typing import Any

from sigmasplat.run_folder.run_values import frame_seconds

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


def shares(seconds: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """Return (stage, seconds, share of the total) of each stage, largest first."""
    whole = sum(seconds.values()) or 1.0
    return sorted(((name, s, s / whole) for name, s in seconds.items()), key=lambda row: -row[1])
