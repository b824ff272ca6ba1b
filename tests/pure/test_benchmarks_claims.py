"""benchmarks/claims.py: which runs it makes, and how the verdicts on the papers' claims follow from figures."""

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paired_comparison import Figure, PairedDifference

from benchmark_results import laid_out, results
from sigmasplat.config.find_preset import preset
from sigmasplat.errors import ConfigError

claims, evidence, tables, record = map(
    importlib.import_module, ("claims", "claims_evidence", "claims_tables", "record")
)
ERROR, SCORE = Figure("error", "error", "cm", -1), Figure("score", "score", "", +1)


def claim(claimed: str, figure: Figure = ERROR, against: str | None = "without") -> Any:
    """Return a claim on what "with" changes."""
    found = evidence.Evidence("made-up", evidence.of_runs, figure, "with", against, "sigma")
    return evidence.Claim("it helps", "a number", claimed, found)


def differences(*means: float, figure: Figure = ERROR) -> list[PairedDifference]:
    """Return the differences of sequences with these means; without a change the figure is 100."""
    return [PairedDifference(figure, (mean - 0.1, mean, mean + 0.1), 100.0) for mean in means]


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
        ("less", (-2.0, -2.5, -1.5), "holds"),
        ("less", (2.0, 2.5, 1.5), "the opposite"),
        ("more", (2.0, 2.5, 1.5), "holds"),
        ("less", (-2.0, -2.5, 1.5), "no clear effect"),
        ("less", (-2.0, -0.1), "no clear effect"),
        ("less", (0.0, 0.0), "no clear effect"),
        ("less", (-2.0,), "one sequence only: not tested"),
        ("no worse", (0.0, 1.0, -1.0), "holds"),
        ("no worse", (2.0, 2.5, 1.5), "holds"),
        ("no worse", (20.0, 25.0, 15.0), "the opposite"),
        ("no worse", (3.0, 0.0, -1.0), "no clear effect"),
    ],
)
def test_a_claim_holds_if_the_interval_over_sequences_lies_on_its_side(
    claimed: str, found: tuple[float, ...], verdict: str
) -> None:
    """An error may be 5 % larger and still not be worse."""
    assert tables.verdict(claim(claimed), differences(*found)) == verdict


def test_not_worse_depends_on_which_direction_is_better() -> None:
    psnr = Figure("psnr", "PSNR", "dB", +1)
    lower = differences(-2.0, -2.5, -1.5, figure=psnr)
    assert tables.verdict(claim("no worse", psnr), lower) == "the opposite"
    assert tables.verdict(claim("no worse"), differences(-2.0, -2.5, -1.5)) == "holds"


@pytest.mark.parametrize("claimed", ["less", "more", "no worse"])
def test_pure_noise_is_a_verdict_in_five_percent_of_cases(claimed: str) -> None:
    """2 to 6 sequences, each with its own noise over 3 to 5 seeds and its own shift, which no seed shows. For "no
    worse" the truth is the margin itself: an error 5 % larger."""
    rng, draws, wrong = np.random.default_rng(1), 4000, 0
    for _ in range(draws):
        made = []
        for scale in 10 ** rng.uniform(-1, 1, rng.integers(2, 7)):
            shift = rng.normal(5.0 if claimed == "no worse" else 0.0, scale)
            made.append(PairedDifference(ERROR, tuple(rng.normal(shift, scale, rng.integers(3, 6))), 100.0))
        found = tables.verdict(claim(claimed), made)
        wrong += found == "holds" if claimed == "no worse" else found != "no clear effect"
    assert wrong / draws <= 0.05 + 3 * (0.05 * 0.95 / draws) ** 0.5


def test_pure_noise_is_an_effect_in_five_percent_of_tables() -> None:
    """On one sequence, of the seeds; in weights.py, of all figures of a change together."""
    rng, draws, names = np.random.default_rng(2), 2000, "abcdefg"
    noise = rng.normal(size=(draws, 5, len(names)))
    found = [
        [PairedDifference(Figure(name, name, "dB", +1, digits=9), tuple(of[:, k])) for k, name in enumerate(names)]
        for of in noise
    ]
    limit = 0.05 + 3 * (0.05 * 0.95 / draws) ** 0.5
    assert sum(differences[0].stands_out for differences in found) / draws <= limit
    judgement = importlib.import_module("weights_tables").judgement
    assert sum(judgement(differences) != "no clear effect" for differences in found) / draws <= limit


def test_a_row_holds_differences_at_equal_seeds_and_where_they_lie(tmp_path: Path) -> None:
    write(tmp_path, pairs("kitchen", -1.0, -1.2, -0.8) + pairs("hall", 1.0, -1.0, 0.3) + pairs("few", -5.0, -5.1))
    said, published, settings, text, interval, judged, provenance = tables.row(claim("less"), tmp_path)
    assert (said, published, settings) == ("it helps", "a number", "other: `sigma`")
    assert "kitchen **−1.00±0.20**" in text and "hall +0.10±1.01" in text
    assert judged == "**no clear effect**" and interval.startswith("−4.1 [") and interval.endswith("] %")
    assert "3 seeds" in provenance and "0123456789ab"[:9] in provenance
    few = tmp_path / "few"
    write(few, pairs("kitchen", -1.0, -1.2) + pairs("hall", 1.0, -1.0))
    assert tables.row(claim("less"), few)[5] == "**fewer than 3 seeds: not tested**"


def test_a_figure_itself_is_compared_with_zero(tmp_path: Path) -> None:
    runs = [(source, "with", seed, 0.5 + 0.1 * seed) for source in ("kitchen", "hall") for seed in range(3)]
    write(tmp_path, runs, "score")
    assert tables.row(claim("more", SCORE, None), tmp_path)[4:6] == ["0.60 [0.60…0.60]", "**holds**"]


def test_figures_that_are_zero_in_all_runs_show_nothing(tmp_path: Path) -> None:
    write(tmp_path, [("kitchen", variant, seed, 0.0) for variant in ("with", "without") for seed in range(3)])
    assert tables.judged(claim("less"), tmp_path)[0] == tables.NOT_MEASURABLE
    assert tables.row(claim("less"), tmp_path)[3] == "error: 0 in all runs"


def test_missing_results_are_named_and_missing_evidence_has_a_reason(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="made-up"):
        tables.row(claim("less"), tmp_path)
    unmeasured = evidence.Claim("it is fast", "a number", "less", None, "no GPU")
    assert tables.row(unmeasured, tmp_path)[3:6] == ["– (no GPU)", "–", tables.NOT_MEASURABLE]


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


def test_every_row_has_a_family_and_a_verdict_and_none_rests_on_one_sequence() -> None:
    for paper, listed in tables.PAPERS.items():
        for one in listed:
            row = tables.row(one, record.RESULTS)
            verdict, found = tables.judged(one, record.RESULTS)
            assert one.evidence is None or row[2] == "the paper's own" or row[2].startswith("other: `"), (paper, row)
            tested = verdict in (tables.HOLDS, tables.OPPOSITE, tables.UNCLEAR)
            assert not tested or len(tables.counting(found)) > 1, row


def test_the_papers_own_settings_replace_the_small_ones() -> None:
    for small, own in claims.OWN.items():
        for job in claims.jobs_of(claims.Options(groups=(own,), seeds=(0,))):
            paper, config = preset(claims.GROUPS[own].preset), job.config()
            assert config.input.width == 320 and config.tracking.iterations == paper.tracking.iterations
            for name in ("iterations", "first_iterations", "every", "lr_means", "lr_log_variances"):
                assert getattr(config.mapping, name) == getattr(paper.mapping, name)
            assert (config.tracking.lr_rotation, config.tracking.method) == (paper.tracking.lr_rotation, "adam")
        papers = importlib.import_module("claims_papers")
        one = papers.in_claims(small, papers.ATE, *list(claims.GROUPS[own].variants)[:2])
        runs = {"figures": {"runs": [{"group": small}, {"group": own}]}}
        assert one.family(runs) == "the paper's own" and [run["group"] for run in one.read(runs)] == [own]
        assert one.family({"figures": {"runs": [{"group": small}]}}).startswith("other")


def test_values_are_tabulated_by_kind_and_sequence() -> None:
    runs = [
        {"source": "kitchen", "seed": seed, "group": "localisation", "variant": name,
         "figures": {"localised_m": 0.01 * k, "steps": 100.0}}
        for seed in range(3)
        for k, name in enumerate(claims.PLATEAUS, 1)
    ]  # fmt: skip
    found = laid_out("claims", {"runs": runs, "missing": 0})["Localisations, kitchen"]
    assert [row[0] for row in found.rows] == [*claims.PLATEAUS] and found.rows[0][1] == "**1**"
