"""Tabulate the figures of the tracking benchmark: errors by gap and method, coverage, complete runs, goals."""

import math
from typing import Any

import numpy as np
from accuracy_tables import PLACE, failed_runs, spread, values_of
from numpy.typing import NDArray
from scipy.stats import chi2
from tables import Section, significant

Matrix = NDArray[np.float64]
Rows = list[dict[str, Any]]
BOUNDS = tuple(float(bound) for bound in chi2.ppf([0.025, 0.975], 6))
"""If covariances are right, 95 % of NEES lie between these: χ² with 6 degrees of freedom."""
AXES = ("ρx", "ρy", "ρz", "φx", "φy", "φz")
NAMES = {
    "guess": "none (pose of the keyframe)",
    "keyframe": "Gauss–Newton, keyframe",
    "map": "Gauss–Newton, map",
    "align": "Gauss–Newton",
}
ERRORS = ("translation_cm", "rotation_deg")
RUN = PLACE[:6]
"""Title, name of the figure, factor to the unit of the title."""
ERROR_FACTOR, TIME_FACTOR, COVERED = 1.1, 20.0, 0.9
"""Issue 3: Gauss–Newton's median error ≤ 1.1 × Adam's at ≤ 1/20 of its time; NEES inside the band on 90 % of frames."""


def coverage(twists: Matrix, covariances: Matrix) -> dict[str, Any]:
    """Summarise how well covariances [N, 6, 6] cover error twists [N, 6], m and rad: NEES ξᵀ Σ⁻¹ ξ against χ²₆.

    z is each error component divided by its estimated deviation; its standard deviation is 1 if the estimate is right.
    """
    nees = np.einsum("ni,nij,nj->n", twists, np.linalg.pinv(covariances, hermitian=True), twists)
    low, high = BOUNDS
    claimed = np.sqrt(np.einsum("nii->ni", covariances))
    z = twists / claimed
    shares = {"inside": (nees >= low) & (nees <= high), "below": nees < low, "above": nees > high}
    vectors = {"z_mean": z.mean(0), "z_std": z.std(0), "error_mean": twists.mean(0), "error_std": twists.std(0)}
    return {
        "frames": len(nees),
        "mean_nees": float(nees.mean()),
        "median_nees": float(np.median(nees)),
        **{name: float(share.mean()) for name, share in shares.items()},
        **{name: vector.tolist() for name, vector in (vectors | {"claimed": claimed.mean(0)}).items()},
    }


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by tracking.py, for the experiments that were run."""
    figures, made = measured["figures"], []
    if "pairs" in figures:
        made += [pairs(figures["pairs"]), ratios(figures["pairs"]["pairs"])]
    if "consistency" in figures:
        made += [consistency(figures["consistency"]), components(figures["consistency"])]
    if "sequence" in figures:
        made += [sequence(figures["sequence"]), failures(figures["sequence"])]
    return [section for section in [*made, goals(figures)] if section.rows]


def named(method: str) -> str:
    """Return a method's name in the tables."""
    return NAMES.get(method) or f"Adam, {method.removeprefix('adam ')}'s rates"


def cells_of(found: Rows) -> list[tuple[int, str]]:
    """List gaps and methods, in order."""
    return list(dict.fromkeys((pair["gap"], pair["method"]) for pair in found))


def column(found: Rows, gap: int, method: str, figure: str) -> list[float]:
    """Return a figure of one gap and method, one value per start and seed."""
    return [pair[figure] for pair in found if (pair["gap"], pair["method"]) == (gap, method)]


def pairs(measured: dict[str, Any]) -> Section:
    """Tabulate the errors of single frames, by gap and method."""
    found, rows = measured["pairs"], []
    for gap, method in cells_of(found):
        figures: list[float | None] = []
        for error in ERRORS:
            e = column(found, gap, method, error)
            figures += [float(np.median(e)), float(np.mean(e)), float(np.percentile(e, 90))]
        figures.append(None if method == "guess" else float(np.median(column(found, gap, method, "ms"))))
        rows.append([str(gap), named(method), *map(significant, figures)])
    head = [
        "frames after keyframe",
        "method",
        "cm, median",
        "… mean",
        "… 90 %",
        "°, median",
        "… mean",
        "… 90 %",
        "ms, median",
    ]
    note = f"{measured['source']}, {len(measured['starts'])} starts, {measured['lost']} of them lost. "
    return Section("Pairs", head, rows, note + "Error of the motion from keyframe to frame.")


def compared(found: Rows, gap: int, method: str) -> dict[str, float]:
    """Divide a method's medians by Adam's, each with the learning rates that are better for it."""
    adams = [m for g, m in cells_of(found) if g == gap and m.startswith("adam")]
    ratio = {}
    for figure in (*ERRORS, "ms"):
        ours, *theirs = (float(np.median(column(found, gap, m, figure))) for m in (method, *adams))
        ratio[figure] = ours / max(min(theirs), 1e-12)
    return ratio


def alignments(found: Rows) -> list[tuple[int, str, dict[str, float]]]:
    """List gap, method and ratios to Adam for every kind of alignment."""
    return [(gap, m, compared(found, gap, m)) for gap, m in cells_of(found) if m in ("keyframe", "map")]


def ratios(found: Rows) -> Section:
    """Tabulate the medians of alignment divided by Adam's."""
    rows = []
    for gap, method, ratio in alignments(found):
        shown = (*(ratio[error] for error in ERRORS), 1 / ratio["ms"])
        rows.append([str(gap), named(method), *map(significant, shown)])
    head = ["frames after keyframe", "method", "translation error / Adam's", "rotation error / Adam's", "times faster"]
    return Section(
        "Ratios", head, rows, "Ratios of medians. Adam uses the learning rates that are better in that column."
    )


def consistency(measured: Rows) -> Section:
    """Tabulate how often the covariance covers the error, for all frames and by frames since the keyframe."""
    rows = []
    for room in measured:
        for age, part in {"all": room["all"], **room["by_age"]}.items():
            figures = [100 * part["inside"], 100 * part["below"], 100 * part["above"]]
            figures += [part["mean_nees"], part["median_nees"]]
            rows.append([room["source"], age, str(part["frames"]), *map(significant, figures)])
    head = ["sequence", "frames since keyframe", "frames", "in the band, %", "below", "above", "NEES, mean", "… median"]
    band = " … ".join(f"{bound:.2f}" for bound in BOUNDS)
    left_out = sum(room["lost"] for room in measured)
    note = f"Ideal: 95 % in the band {band}, mean 6, median 5.35. Left out (lost or without covariance): {left_out}."
    return Section("Consistency", head, rows, note)


def components(measured: Rows) -> Section:
    """Tabulate the error of each component and its estimated deviation."""
    rows = []
    for room, axis in ((room, axis) for room in measured for axis in range(6)):
        part, unit = room["all"], 1e3 if axis < 3 else 1e3 * math.degrees(1.0)
        figures = [unit * part[name][axis] for name in ("error_mean", "error_std", "claimed")]
        figures += [part[name][axis] for name in ("z_mean", "z_std")]
        rows.append([room["source"], AXES[axis], *map(significant, figures)])
    head = [
        "sequence",
        "component",
        "error, mean",
        "… deviation",
        "estimated",
        "error / estimated, mean",
        "… deviation",
    ]
    return Section("Components", head, rows, "ρ in mm, φ in thousandths of a degree, in the live camera's axes.")


def sequence(jobs: Rows) -> Section:
    """Tabulate complete runs by sequence and method."""
    rows = []
    for source, method in dict.fromkeys((job["source"], job["method"]) for job in jobs):
        done = succeeded(jobs, source, method)
        cells = [spread([factor * value for value in values_of(done, name)]) for _, name, factor in RUN]
        rows.append([source, named(method), str(len(done)), *cells])
    head = ["sequence", "method", "runs", *(title for title, _, _ in RUN)]
    return Section("Sequence", head, rows, "Mean ± standard deviation over the seeds.")


def succeeded(jobs: Rows, source: str, method: str) -> Rows:
    """Return the successful runs of a sequence by a method."""
    return [job for job in jobs if (job["source"], job["method"], job["problem"]) == (source, method, None)]


def failures(jobs: Rows) -> Section:
    """List the runs that failed, with the last line they printed."""
    return failed_runs(jobs, lambda job: f"{job['source']}, {named(job['method'])}, seed {job['seed']}")


def goals(figures: dict[str, Any]) -> Section:
    """Compare the results with the goals of issue 3; complete runs by the mean over their seeds."""
    held: list[tuple[str, float, float]] = []
    for gap, method, ratio in alignments(figures.get("pairs", {}).get("pairs", [])):
        title = f"{named(method)}, {gap} frames after the keyframe:"
        held += [(f"{title} {error.split('_')[0]} error / Adam's", ratio[error], ERROR_FACTOR) for error in ERRORS]
        held.append((f"{title} time / Adam's", ratio["ms"], 1 / TIME_FACTOR))
    for room in figures.get("consistency", []):
        held.append((f"{room['source']}: share of frames outside the band", 1 - room["all"]["inside"], 1 - COVERED))
    jobs = figures.get("sequence", [])
    for source in dict.fromkeys(job["source"] for job in jobs):
        runs = {method: succeeded(jobs, source, method) for method in dict.fromkeys(job["method"] for job in jobs)}
        ate_m = {method: float(np.mean(values_of(done, "ate_m"))) for method, done in runs.items() if done}
        ours, theirs = ate_m.pop("align", None), min(ate_m.values(), default=None)
        if ours is not None and theirs is not None:
            held.append((f"{source}: ATE, cm; goal: that of the better Adam", 100 * ours, 100 * theirs))
    rows = [
        [what, significant(value), f"≤ {significant(most)}", "yes" if value <= most + 1e-12 else "**no**"]
        for what, value, most in held
    ]
    return Section("Goals", ["figure", "measured", "goal", "reached"], rows)
