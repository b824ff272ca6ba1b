"""Lay out what color_covariance.py measured."""

from typing import Any

import numpy as np
from accuracy_tables import spread
from tables import Section

KINDS = ("diagonal", "full")


def sections(measured: dict[str, Any]) -> list[Section]:
    """Lay out the figures: one row for each sequence and map, means ± deviations over the seeds."""
    rows = []
    for source in measured["figures"]["sources"]:
        for kind in KINDS:
            found = [run[kind] for run in source["runs"]]
            ratios = [run["mapping_time_ratio"] for run in source["runs"]] if kind == "full" else [1.0]
            together = [float(np.mean(run["mean_correlation"])) for run in found]
            names = ("nll_diagonal", "nll_full", "psnr_db", "spearman")
            columns = [ratios, *([run[name] for run in found] for name in names[:2]), together]
            columns += [[run[name] for run in found] for name in names[2:]]
            rows.append([source["source"], kind, *(spread(values) for values in columns)])
    head = ("sequence", "map", "mapping time", "NLL, diagonal", "NLL, full", "mean absolute ρ", "PSNR, dB", "Spearman")
    note = "NLL in nats per pixel, 3 channels, on held-out frames, under V's diagonal and under all of V."
    return [Section("colour covariance", head, rows, note)]
