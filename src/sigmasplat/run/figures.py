"""Turn figures into text."""

import math


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
