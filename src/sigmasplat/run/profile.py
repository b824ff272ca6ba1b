"""Say where a run's time went: the kernels, the loss, the optimiser, alignment, input and the rest."""

from collections.abc import Iterable, Mapping
from typing import Any

STAGES: dict[str, tuple[str, ...]] = {
    "project": ("project",),
    "sort": ("sort",),
    "blend": ("blend",),
    "loss": ("map_loss",),
    "backward": ("blend_backward",),
    "optimiser": ("project_backward",),
    "prepare": ("prepare",),
}
"""Stages that a step's log line counts by itself, and the counters each adds up."""


def profile(steps: Iterable[Mapping[str, Any]], wall_s: float) -> dict[str, float]:
    """Add up log lines' seconds by stage; the stages sum to wall_s.

    backward: from pixels to splats; optimiser: on from there to parameters, and Adam, in one pass; align: tracking
    without its renders; other: seeding, pruning and Python; io: waiting for frames and writing the log.
    """
    lines = [step["seconds"] for step in steps]
    total = {stage: sum(line.get(name, 0.0) for line in lines for name in names) for stage, names in STAGES.items()}
    total["align"] = sum(line.get("track", 0.0) - line.get("track_kernels", 0.0) for line in lines)
    inside = sum(line["total"] for line in lines)
    total["other"] = max(inside - sum(total.values()), 0.0)
    total["io"] = max(wall_s - inside, 0.0)
    return total


def shares(seconds: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """List (stage, seconds, share of the whole), largest first."""
    whole = sum(seconds.values()) or 1.0
    return sorted(((name, s, s / whole) for name, s in seconds.items()), key=lambda row: -row[1])
