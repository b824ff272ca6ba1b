"""Lay out what drift_rule.py measured: is the truth worse where submaps are cut?"""

from typing import Any

import numpy as np
from tables import Section, significant

Rows = list[dict[str, Any]]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return one table: a row for each sequence."""
    rows = []
    for found in measured["figures"]["sources"]:
        hops: Rows = found["hops"]
        errors_cm = {cut: [100 * hop["error_m"] for hop in hops if hop["cut"] is cut] for cut in (True, False)}
        counts = [str(len(hops)), str(found["submaps"]), str(found["lost"])]
        cells = [level(errors_cm[cut], share) for cut in (True, False) for share in (0.5, 0.9)]
        rows.append([found["source"], *counts, *cells])
    head = ["sequence", "hops", "submaps", "lost frames", "error of hops where it fires, cm: median", "… 90 %"]
    head += ["where it does not, cm: median", "… 90 %"]
    limit_cm = significant(100 * measured["config"]["uncertainty_m"])
    note = (
        f"A submap ends where the camera's position in it is uncertain by more than {limit_cm} cm. Hops lead from "
        "keyframe to keyframe; their errors are against the truth, which the rule does not know."
    )
    return [Section("the uncertainty rule", head, rows, note)]


def level(errors: list[float], share: float) -> str:
    """Return the error that a share of them stays below; a dash where there are none."""
    return significant(float(np.quantile(errors, share))) if errors else "–"
