"""Lay out the ablation of the consistent field: the mean of the scenes, what each part does, and a table a scene."""

import statistics
from typing import Any

from accuracy_tables import failures
from tables import Section

from sigmasplat.evaluation.paired_comparison import (
    Figure,
    PairedDifference,
    best,
    by_seed,
    deviation,
    passed_by_chance,
    rows,
)
from sigmasplat.report.tables import number

Scenes = dict[str, list[dict[str, Any]]]
"""Runs by scene, each with `variant`, `seed` and `figures`."""
FULL = "full"
FIGURES = (
    Figure("ate_m", "ATE", "cm", -1, 100.0),
    Figure("splats_chamfer_m", "Chamfer", "cm", -1, 100.0),
    Figure("splats_accuracy_m", "splats to surface", "cm", -1, 100.0),
    Figure("splats_completion_m", "surface to splats", "cm", -1, 100.0),
    Figure("floaters", "floaters", "%", -1, 100.0),
    Figure("held_out_psnr_db", "PSNR", "dB", +1),
    Figure("held_out_depth_l1_m", "depth L1", "cm", -1, 100.0),
    Figure("splats", "splats", "k", 0, 1e-3, digits=1, judged=False),
    Figure("lost", "lost", "", -1, digits=1, judged=False),
)
JUDGED = tuple(figure for figure in FIGURES if figure.judged)
HEADS = [figure.head for figure in FIGURES]


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results written by consistency.py."""
    results = measured["figures"]["jobs"]
    variants, scenes = list(dict.fromkeys(result["variant"] for result in results)), by_scene(results)
    made = [mean_of(scenes, variants), effects_of(scenes, variants)]
    made += [scene(name, runs, variants) for name, runs in scenes.items()]
    return [section for section in [*made, failures(results)] if section.rows]


def by_scene(results: list[dict[str, Any]]) -> Scenes:
    """Group the runs that succeeded."""
    found: Scenes = {}
    for result in results:
        if result["problem"] is None:
            found.setdefault(result["job"]["source"], []).append(result | {"seed": result["job"]["seed"]})
    return found


def scene(name: str, runs: list[dict[str, Any]], variants: list[str]) -> Section:
    """Lay out a scene, a row a variant: mean ± standard deviation over its seeds, the best of each column in bold."""
    laid_out = rows(runs, variants, lambda text: f"**{text}**", FIGURES)
    return Section(name, ["variant", *HEADS], laid_out, "Mean ± standard deviation over the seeds; views are held out.")


def mean_of(scenes: Scenes, variants: list[str]) -> Section:
    """Lay out the mean over the scenes of each scene's mean over its seeds, of the scenes that every variant has."""
    columns = []
    for figure in FIGURES:
        found = [{v: list(by_seed(runs, v, figure).values()) for v in variants} for runs in scenes.values()]
        whole = [by_variant for by_variant in found if all(by_variant.values())]
        means = {v: statistics.fmean(statistics.fmean(b[v]) for b in whole) for v in variants} if whole else {}
        top = best(means, figure)
        columns.append([_marked(number(means[v], figure.digits), v in top) if means else "–" for v in variants])
    laid_out = [[variant, *cells] for variant, *cells in zip(variants, *columns, strict=True)]
    return Section("Mean of scenes", ["variant", *HEADS], laid_out if scenes else [])


def differences(scenes: Scenes, variant: str, figure: Figure) -> list[float]:
    """Return what a variant changes against the full method, at equal scene and seed, in the figure's unit."""
    pairs = [(by_seed(runs, variant, figure), by_seed(runs, FULL, figure)) for runs in scenes.values()]
    return [there[seed] - full[seed] for there, full in pairs for seed in there if seed in full]


def effects_of(scenes: Scenes, variants: list[str]) -> Section:
    """Lay out the differences to the full method, those beyond one standard deviation in bold."""
    laid_out, most = [], 0
    for variant in (variant for variant in variants if variant != FULL):
        changes = [(figure, differences(scenes, variant, figure)) for figure in JUDGED]
        most = max(most, *(len(found) for _, found in changes))
        laid_out.append([variant, *(_effect(figure, found) for figure, found in changes)])
    note = (
        "Difference to the full method at equal scene and seed: mean ± standard deviation, and in how many it is worse."
    )
    if most > 1:
        note += f" Bold: beyond one deviation, as {passed_by_chance(most):.1%} of figures are by chance."
    return Section("Effects", ["variant", *(f.title for f in JUDGED)], laid_out if most else [], note)


def _effect(figure: Figure, changes: list[float]) -> str:
    if not changes:
        return "–"
    effect = PairedDifference(figure, statistics.fmean(changes), deviation(changes))
    worse = sum(figure.better * change < 0 for change in changes)
    return f"{_marked(effect.written(), effect.verdict in ('helps', 'harms'))}, {worse}/{len(changes)}"


def _marked(text: str, stands_out: bool) -> str:
    return f"**{text}**" if stands_out else text
