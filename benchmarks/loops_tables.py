"""Tabulate the figures of the loop benchmark: runs with and without loops, the loops, the goals of issue 4."""

import statistics
from typing import Any

from accuracy_tables import failed_runs, spread, values_of
from tables import Section, significant

Rows = list[dict[str, Any]]
FALSE_TRANSLATION_M, FALSE_ROTATION_DEG = 0.3, 10.0
"""A loop is false if its relative pose of the two submaps differs from the true one by more than this."""
RATIO = 0.6
"""Issue 4: ATE with loops ≤ 60 % of ATE without."""
RUN = (
    ("ATE, cm", "ate_m", 100.0),
    ("PSNR held-out, dB", "held_out_psnr_db", 1.0),
    ("… training", "training_psnr_db", 1.0),
    ("depth L1 held-out, cm", "held_out_depth_l1_m", 100.0),
    ("lost", "lost", 1.0),
    ("submaps", "submaps", 1.0),
    ("frames/s", "frames_per_s", 1.0),
    ("peak memory, MiB", "peak_mib", 1.0),
)
"""Title, name of the figure, factor to the unit of the title."""


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by loops.py."""
    jobs = measured["figures"]["jobs"]
    made = [runs(jobs), seeds(jobs), edges(jobs), goals(jobs), failures(jobs)]
    return [section for section in made if section.rows]


def succeeded(jobs: Rows, experiment: str, way: str | None = None) -> Rows:
    """Return the successful runs of an experiment, all or those of one variant."""
    return [j for j in jobs if j["experiment"] == experiment and way in (None, j["way"]) and j["problem"] is None]


def accepted(job: dict[str, Any], true: bool) -> int:
    """Count the true or the false loops among a run's accepted ones."""
    return sum(loop["accepted"] and loop["true"] is true for loop in job["loops"])


def runs(jobs: Rows) -> Section:
    """Tabulate the runs by experiment and variant."""
    rows = []
    for experiment, way in dict.fromkeys((job["experiment"], job["way"]) for job in jobs):
        done = succeeded(jobs, experiment, way)
        cells = [spread([factor * value for value in values_of(done, name)]) for _, name, factor in RUN]
        rows.append([done[0]["source"] if done else experiment, way, str(len(done)), *cells])
    head = ["sequence", "variant", "runs", *(title for title, _, _ in RUN)]
    return Section("Runs", head, rows, "Mean ± standard deviation over the seeds.")


def paired(jobs: Rows, experiment: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Pair each run with loops with one without. For drift this is the same run's path by tracking alone, equal bit
    for bit to a run without loops (tests/system/test_submaps.py); otherwise the run with the same seed."""
    done = succeeded(jobs, experiment)
    if experiment == "drift":
        return [(job, job | {"figures": job["figures"] | {"ate_m": without_loops_m(job)}}) for job in done]
    without = {job["seed"]: job for job in done if job["way"] != "loops"}
    return [(job, without[job["seed"]]) for job in done if job["way"] == "loops" and job["seed"] in without]


def without_loops_m(job: dict[str, Any]) -> float:
    """Return the ATE of a run's path without loops, m; without accepted loops that of the path."""
    found: float | None = job["figures"].get("ate_odometry_m")
    return job["figures"]["ate_m"] if found is None else found


def seeds(jobs: Rows) -> Section:
    """Tabulate each seed's ATE with and without loops, and how many loops were tried, accepted, true and false."""
    rows = []
    for experiment in dict.fromkeys(job["experiment"] for job in jobs):
        for job, other in paired(jobs, experiment):
            ours_m, theirs_m = job["figures"]["ate_m"], other["figures"]["ate_m"]
            right, wrong = accepted(job, True), accepted(job, False)
            bent = sum(not loop["accepted"] and loop["true"] for loop in job["loops"])
            caught = sum(not loop["accepted"] and not loop["true"] for loop in job["loops"])
            cells = [significant(100 * ours_m), significant(100 * theirs_m), significant(ours_m / theirs_m)]
            counts = [job["submaps"], job["tried"], right + wrong, right, wrong, bent, caught]
            rows.append([job["source"], str(job["seed"]), *cells, *map(str, counts)])
    head = ["sequence", "seed", "ATE, cm", "… without loops", "ratio", "submaps", "loops tried", "accepted", "… true"]
    head += ["… false", "true loops rejected by the pose graph", "false loops rejected"]
    note = (
        f"False: more than {FALSE_TRANSLATION_M} m or {FALSE_ROTATION_DEG:.0f}° from the true relative pose of the "
        "first keyframes of both submaps."
    )
    return Section("Seeds", head, rows, note)


def edges(jobs: Rows) -> Section:
    """List the accepted loops of the real sequence with their residuals."""
    rows = []
    for job in succeeded(jobs, "real", "loops"):
        for loop in filter(lambda loop: loop["accepted"], job["loops"]):
            between = f"{loop['database']} ← {loop['query']}"
            frames = f"{loop['database_frame']} ← {loop['query_frame']}"
            moved = [100 * loop["translation_m"], loop["rotation_deg"], 100 * loop["error_m"], loop["error_deg"]]
            figures = [loop["similarity"], loop["residual"], loop["overlap"], loop["chi2"], *moved]
            rows.append([str(job["seed"]), between, frames, *map(significant, figures)])
    head = ["seed", "submaps", "frames", "similarity", "residual", "overlap", "χ²", "correction, cm", "… °"]
    return Section("Edges", [*head, "error, cm", "… °"], rows)


def goals(jobs: Rows) -> Section:
    """Compare the loops with the goals of issue 4: the ATE ratio of every seed and of the means."""
    rows = []
    pairs = paired(jobs, "drift")
    if pairs:
        right, wrong = ([accepted(job, true) for job, _ in pairs] for true in (True, False))
        ratios = [job["figures"]["ate_m"] / other["figures"]["ate_m"] for job, other in pairs]
        of_means = _mean_ate_m(job for job, _ in pairs) / _mean_ate_m(other for _, other in pairs)
        rows.append(_row("drift: true loops closed, each seed", right, "≥ 1", min(right) >= 1))
        rows.append(_row("drift: false loops closed, all seeds", [sum(wrong)], "0", sum(wrong) == 0))
        rows.append(_row("drift: ATE with loops / without, of means", [of_means], f"≤ {RATIO}", of_means <= RATIO))
        rows.append(_row("… each seed", ratios, f"≤ {RATIO}", max(ratios) <= RATIO))
    pairs = paired(jobs, "real")
    if pairs:
        ours_cm, theirs_cm = (100 * _mean_ate_m(pair[k] for pair in pairs) for k in (0, 1))
        title = f"{pairs[0][0]['source']}: ATE, cm; goal: that of one submap"
        rows.append(_row(title, [ours_cm], f"≤ {significant(theirs_cm)}", ours_cm <= theirs_cm))
    return Section("Goals", ["figure", "measured", "goal", "reached"], rows)


def _mean_ate_m(jobs: Any) -> float:
    return statistics.fmean(job["figures"]["ate_m"] for job in jobs)


def _row(what: str, values: list[Any], goal: str, held: bool) -> list[str]:
    shown = [str(value) if isinstance(value, int) else significant(value) for value in values]
    return [what, ", ".join(shown), goal, "yes" if held else "**no**"]


def failures(jobs: Rows) -> Section:
    """List the runs that failed, with the last line they printed."""
    return failed_runs(jobs, lambda job: f"{job['source']}, {job['way']}, seed {job['seed']}")
