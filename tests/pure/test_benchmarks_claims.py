"""benchmarks/claims.py: which runs it makes, and how the verdicts on the papers' claims follow from figures."""

import importlib
from pathlib import Path
from typing import Any

import pytest
from paired_comparison import Figure, PairedDifference

from benchmark_results import laid_out, results
from sigmasplat.errors import ConfigError

claims, evidence, tables, record = map(
    importlib.import_module, ("claims", "claims_evidence", "claims_tables", "record")
)
ERROR, SCORE = Figure("error", "error", "cm", -1), Figure("score", "score", "", +1)


def claim(claimed: str, figure: Figure = ERROR, against: str | None = "without") -> Any:
    """Return a claim on what "with" changes."""
    found = evidence.Evidence("made-up", evidence.of_runs, figure, "with", against)
    return evidence.Claim("it helps", "a number", claimed, found)


def differences(*pairs: tuple[float, float], figure: Figure = ERROR) -> list[PairedDifference]:
    """Return differences by mean and deviation."""
    return [PairedDifference(figure, mean, deviation) for mean, deviation in pairs]


def write(folder: Path, runs: list[tuple[str, str, int, float]], figure: str = "error") -> None:
    """Write made-up results of runs: source, variant, seed, value."""
    named = [{"source": s, "variant": v, "seed": k, "figures": {figure: x}} for s, v, k, x in runs]
    record.write(results("ablation", {"runs": named}, name="made-up"), folder)


def pairs(source: str, *changes: float, base: float = 10.0) -> list[tuple[str, str, int, float]]:
    """Return a run with and one without for each change, one seed each."""
    return [
        run
        for seed, change in enumerate(changes)
        for run in ((source, "without", seed, base + seed), (source, "with", seed, base + seed + change))
    ]


def test_every_variant_differs_from_the_others_on_each_sequence() -> None:
    jobs = claims.jobs_of(claims.Options(seeds=(2,)))
    assert len({job.key for job in jobs}) == len(jobs)
    configs = {job.key: job.config() for job in jobs}
    for job in jobs:
        others = [j for j in jobs if (j.group, j.source) == (job.group, job.source)]
        assert all((configs[j.key] == configs[job.key]) is (j.variant == job.variant) for j in others)
        assert configs[job.key].seed == 2 and configs[job.key].input.hold_every == 8
    assert {job.source for job in jobs if job.variant == claims.DOUBLE} == {"redkitchen", "livingroom"}
    assert [j.seed for j in claims.jobs_of(claims.Options(groups=("submaps",), sources=("hololens",)))] == [0, 1, 2]
    with pytest.raises(ConfigError, match="no 'other'"):
        claims.jobs_of(claims.Options(variants=("other",)))


def test_weights_of_both_papers_track_by_descent_through_the_renderer() -> None:
    jobs = [job for job in claims.jobs_of(claims.Options(seeds=(0,))) if job.group != "submaps"]
    assert {job.config().tracking.method for job in jobs} == {"adam"}
    by_variant = {job.variant: job.config() for job in jobs if job.source == "livingroom"}
    assert by_variant["V in tracking"].tracking.uncertainty and not by_variant["no weights"].tracking.uncertainty
    assert by_variant["no weights"].mapping.weight_nll_color > 0 == by_variant["no likelihood"].mapping.weight_nll_color
    assert by_variant["full"].render.covariance_pose_gradient
    assert not by_variant["simplified gradient"].render.covariance_pose_gradient


@pytest.mark.parametrize(
    ("claimed", "found", "verdict"),
    [
        ("less", [(-2.0, 1.0), (-2.0, 1.0), (2.0, 1.0)], "reproduced"),
        ("less", [(-2.0, 1.0), (-0.5, 1.0), (-0.5, 1.0)], "not reproduced"),
        ("less", [(-2.0, 1.0), (-0.5, 1.0)], "not reproduced"),
        ("less", [(2.0, 1.0), (2.0, 1.0), (-0.5, 1.0)], "the opposite"),
        ("more", [(2.0, 1.0), (2.0, 1.0), (-0.5, 1.0)], "reproduced"),
        ("less", [(0.0, 0.0)], "not reproduced"),
        ("no worse", [(0.5, 1.0), (-2.0, 1.0), (2.0, 1.0)], "reproduced"),
        ("no worse", [(2.0, 1.0), (2.0, 1.0), (-0.5, 1.0)], "the opposite"),
        ("less", [], "not measured yet"),
    ],
)
def test_a_claim_is_reproduced_if_most_sequences_show_it_beyond_one_deviation(
    claimed: str, found: list[tuple[float, float]], verdict: str
) -> None:
    assert tables.verdict(claim(claimed), differences(*found)) == verdict


def test_not_worse_depends_on_which_direction_is_better() -> None:
    lower = differences((-2.0, 1.0), figure=SCORE)
    assert tables.verdict(claim("no worse", SCORE), lower) == "the opposite"
    assert tables.verdict(claim("no worse"), differences((-2.0, 1.0))) == "reproduced"


def test_a_row_holds_differences_at_equal_seeds_and_where_they_lie(tmp_path: Path) -> None:
    write(tmp_path, pairs("kitchen", -1.0, -2.0, -3.0) + pairs("hall", 1.0, -1.0, 0.3) + pairs("few", -5.0, -5.1))
    said, published, text, judged, provenance = tables.row(claim("less"), tmp_path)
    assert (said, published) == ("it helps", "a number")
    assert "kitchen **−2.00 ± 1.00**" in text and "hall +0.10 ± 1.01" in text and "few" not in text
    assert judged == "**not reproduced**: as claimed on 1 of 2"
    assert "3 seeds" in provenance and "0123456789ab"[:9] in provenance


def test_a_figure_itself_is_compared_with_zero(tmp_path: Path) -> None:
    write(tmp_path, [("kitchen", "with", seed, 0.5 + 0.1 * seed) for seed in range(3)], "score")
    assert "**reproduced**: as claimed on 1 of 1" in tables.row(claim("more", SCORE, None), tmp_path)


def test_figures_that_are_zero_in_all_runs_show_nothing(tmp_path: Path) -> None:
    write(tmp_path, [("kitchen", variant, seed, 0.0) for variant in ("with", "without") for seed in range(3)])
    assert tables.judged(claim("less"), tmp_path) == (tables.NOT_MEASURABLE, {})


def test_missing_results_are_named_and_missing_evidence_has_a_reason(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="made-up"):
        tables.row(claim("less"), tmp_path)
    unmeasured = evidence.Claim("it is fast", "a number", "less", None, "no GPU")
    assert tables.row(unmeasured, tmp_path)[2:4] == ["– (no GPU)", tables.NOT_MEASURABLE]


def test_every_claim_names_variants_that_are_measured() -> None:
    of_groups = {name for group in claims.GROUPS.values() for name in group.variants}
    made = of_groups | {*claims.REGISTRATIONS, *claims.PLATEAUS, "covariance"}
    for listed in (listed for named in tables.PAPERS.values() for listed in named):
        assert listed.evidence or listed.remark, listed.said
        if listed.evidence and listed.evidence.results == "claims":
            assert {listed.evidence.changed, listed.evidence.against or listed.evidence.changed} <= made, listed.said
        else:
            verdict, found = tables.judged(listed, record.RESULTS)
            assert found or verdict == tables.NOT_MEASURABLE, listed.said


def test_values_are_tabulated_by_kind_and_sequence() -> None:
    runs = [
        {"source": "kitchen", "seed": seed, "group": "localisation", "variant": name,
         "figures": {"localised_m": 0.01 * k, "steps": 100.0}}
        for seed in range(3)
        for k, name in enumerate(claims.PLATEAUS, 1)
    ]  # fmt: skip
    found = laid_out("claims", {"runs": runs, "missing": 0})["Localisations, kitchen"]
    assert [row[0] for row in found.rows] == [*claims.PLATEAUS] and found.rows[0][1] == "**1**"
