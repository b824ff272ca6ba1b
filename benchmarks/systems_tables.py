"""Lay the systems side by side: a table a sequence, a column a preset, mean ± standard deviation over seeds."""

from typing import Any

from accuracy_tables import Result, failures, groups, spread, values_of
from tables import Section

ROWS = (
    ("ATE, cm", "ate_m", 100.0),
    ("lost frames", "lost", 1.0),
    ("PSNR held-out, dB", "held_out_psnr_db", 1.0),
    ("depth L1 held-out, cm", "held_out_depth_l1_m", 100.0),
    ("Spearman V ~ error²", "spearman", 1.0),
    ("Accuracy, cm", "accuracy_m", 100.0),
    ("Completion, cm", "completion_m", 100.0),
    ("Completion ratio, %", "completion_ratio", 100.0),
    ("Chamfer of splats, cm", "splats_chamfer_m", 100.0),
    ("map, MB", "map_bytes", 1e-6),
    ("splats, k", "splats", 1e-3),
    ("frames/s", "frames_per_s", 1.0),
    ("finish, s", "finish_s", 1.0),
    ("worst frame, ms", "worst_frame_s", 1e3),
    ("peak memory, MiB", "peak_mib", 1.0),
)
"""Title, name of the figure, factor; a row that no run has is left out."""
NOTE = (
    "Mean ± standard deviation over the seeds. Frames/s: reading, tracking, mapping and loops, end to end; the final "
    "map comes after and is `finish`. Worst frame: without the first, which makes the map, and without reading."
)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by systems.py: one per sequence, and what failed."""
    results = measured["figures"]["jobs"]
    sources = dict.fromkeys(result["job"]["source"] for result in results)
    made = [sequence(source, [r for r in results if r["job"]["source"] == source]) for source in sources]
    return [section for section in [*made, failures(results)] if section.rows]


def sequence(source: str, results: list[Result]) -> Section:
    """Lay out the runs of one sequence."""
    by_preset = {preset: runs for (_, preset), runs in groups(results).items()}
    rows = [["runs", *(str(len(runs)) for runs in by_preset.values())]]
    for title, figure, factor in ROWS:
        values = [[factor * value for value in values_of(runs, figure)] for runs in by_preset.values()]
        rows += [[title, *map(spread, values)]] if any(values) else []
    return Section(source, ["", *by_preset], rows, NOTE)
