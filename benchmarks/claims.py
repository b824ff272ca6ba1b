"""Measure the claims of VarSplat and CG-SLAM that no other benchmark measures: runs with and without one ingredient.

Small images and short recordings, one thread. Poses are found by descent through the renderer, in fewer steps than in
the papers; the groups "…-own" have the papers' own iterations and rates at 320 pixels, and take hours.
Finished jobs are kept in runs/bench/claims/NAME.jsonl and are not repeated while code and settings are unchanged.
Writes benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` writes the table of all claims, which
also reads other results, into docs/claims.md.

example: python benchmarks/claims.py --groups cgslam --sources livingroom --seeds 0
"""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import ablation
import program
import record
import tables
import tyro
from pose_gradient import ONE_MAP, RATES

import sigmasplat
from sigmasplat.commands.options import Settings
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.files.machine import INSTALLED, code_digest

arg = tyro.conf.arg
ROOM = "synthetic:frames=200,width=160,height=120,noise=1,seed={seed}"
"""A different room for each seed, with the noise of a sensor."""
COMMON = ("input.hold_every=8", "uncertainty.probes=0", "final.iterations=0", "loops.close=false")
"""Settings of all runs; --set adds to them."""
SMALL = ("input.width=160", "seeding.first_uniform=9600", "seeding.first_gradient=3840")
"""Seeds are as dense as those of the preset at its own width."""
OWN = {"varsplat": "varsplat-own", "cgslam": "cgslam-own"}
"""Groups with the papers' own iterations and rates; in the table they replace the small ones once they are measured."""
OWN_SOURCES = {name: ("input.limit=120",) for name in ("redkitchen", "fr1_xyz", "livingroom")}
DESCENT = ("tracking.method=adam", "tracking.iterations=15", f"tracking.lr_translation={RATES['CG-SLAM'][1]}")
TERMS_OFF = ("mapping.weight_alignment=0", "mapping.weight_moment=0")
DOUBLE = "double width"
"""The others are the light form of it."""
SURFACE = ("full", "without both", "without alignment", "without variance")
"""Variants that are made of the synthetic room too, whose true surface is known."""


@dataclass(frozen=True)
class Group:
    """Runs that are compared: sequences with their settings, a preset, settings of all, and variants of them."""

    preset: str
    sources: dict[str, tuple[str, ...]]
    settings: tuple[str, ...]
    variants: dict[str, tuple[str, ...]]
    size: tuple[str, ...] = SMALL


VARSPLAT = {
    "V in tracking": ("tracking.uncertainty=true",),
    "no weights": ("tracking.uncertainty=false",),
    "no likelihood": ("tracking.uncertainty=false", "mapping.weight_nll_color=0", "mapping.weight_nll_depth=0"),
}
CGSLAM = {
    "full": (),
    "simplified gradient": ("render.covariance_pose_gradient=false",),
    "without both": TERMS_OFF,
    "without isotropy": ("mapping.weight_isotropy_ratio=0",),
    "without fading": ("primitives.uncertain_m2=0",),
    "without alignment": TERMS_OFF[:1],
    "without variance": TERMS_OFF[1:],
}
GROUPS: dict[str, Group] = {
    "varsplat": Group(
        "varsplat-fast",
        {name: ("input.stride=2", "input.limit=50") for name in ("redkitchen", "livingroom")},
        (*ONE_MAP, *DESCENT, f"tracking.lr_rotation={RATES['CG-SLAM'][0]}", "tracking.weight_color=0.6"),
        VARSPLAT,
    ),
    "cgslam": Group(
        "cgslam-fast",
        {"redkitchen": ("input.limit=30",), "livingroom": ("input.limit=30",), "synthetic": ("input.limit=20",)},
        (
            *DESCENT, "tracking.iterations=30", "tracking.lr_rotation=0.0015", "tracking.descent=axis-angle",
            "tracking.weight_color=0.625", "tracking.uncertainty=false", "tracking.alpha_power=0",
            "tracking.alpha_above=0.99", "tracking.outlier_factor=10",
        ),
        CGSLAM | {DOUBLE: ("input.width=320", "seeding.first_uniform=38400", "seeding.first_gradient=15360")},
    ),
    "submaps": Group(
        "varsplat-fast",
        {
            "redkitchen": ("input.stride=2", "input.limit=120"),
            "livingroom": ("input.stride=2", "input.limit=120"),
            "hololens": ("input.limit=80",),
        },
        (*ONE_MAP, "submaps.frames=20"),
        {"submaps": ()},
    ),
    OWN["varsplat"]: Group("varsplat-tum", OWN_SOURCES, (), VARSPLAT, ("input.width=320", "input.crop_px=8")),
    OWN["cgslam"]: Group("cgslam-tum", OWN_SOURCES, (), CGSLAM, ("input.width=320", "input.crop_px=4")),
}  # fmt: skip
"""The variants of a group are made in this order, each on all sequences with all seeds. "double width": the others are
the light form of it. In "submaps" nothing is left out: its maps are registered with several settings. In "…-own",
`crop_px` is the preset's, scaled as the images are."""
REGISTRATIONS = {"mean over pixels": "pixels", "mean over values": "values"}
PLATEAUS = {"no stop": (0.0, 10), "window 10": (1e-4, 10), "window 1": (1e-4, 1)}
"""How submaps of a run are registered, and where the descent stops that localises held-back frames: at steps that lower
the loss by less than this share, so many in a row."""
RUNS = record.ROOT / "runs" / "bench" / "claims"


@dataclass(frozen=True)
class Options:
    """Measure the claims of VarSplat and CG-SLAM that no other benchmark measures."""

    groups: Annotated[tuple[str, ...], arg(help=f"what to measure: {', '.join(GROUPS)}")] = tuple(
        name for name in GROUPS if name not in OWN.values()
    )
    sources: Annotated[tuple[str, ...], arg(help="sequences", help_behavior_hint="(default: those of the group)")] = ()
    variants: Annotated[
        tuple[str, ...], arg(help="runs to make", help_behavior_hint="(default: all of the group)")
    ] = ()
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run for each")] = (0, 1, 2)
    settings: Settings = ()
    collect: Annotated[bool, arg(help="make no run; write the results of the finished jobs")] = False
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "claims"
    runs: Annotated[Path, arg(help="folder of finished jobs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    @property
    def file(self) -> Path:
        """Return the file that finished jobs are added to."""
        return self.runs / f"{record.slug(self.name)}.jsonl"


@dataclass(frozen=True)
class Job:
    """One run: group, sequence, seed, variant, and all settings that differ from the group's preset."""

    group: str
    source: str
    seed: int
    variant: str
    settings: tuple[str, ...]

    @property
    def path(self) -> str:
        """Return the source to open."""
        at = ROOM if self.source == "synthetic" else ablation.located(self.source)
        return at.replace("{seed}", str(self.seed))

    def config(self, more: tuple[str, ...] = ()) -> Config:
        """Return all settings. Raises ConfigError for an unknown one."""
        changed = split_settings([*self.settings, *more, f"seed={self.seed}"])
        return override(preset(GROUPS[self.group].preset), changed)

    @property
    def key(self) -> str:
        """Return what identifies the job in the file of finished jobs."""
        return json.dumps(asdict(self), sort_keys=True)


def jobs_of(options: Options) -> list[Job]:
    """List the jobs, variant by variant. Raises ConfigError for an unknown group, variant or setting."""
    for wanted, known in (
        (options.groups, [*GROUPS]),
        (options.variants, [name for group in GROUPS.values() for name in group.variants]),
    ):
        unknown = [name for name in wanted if name not in known]
        if unknown:
            raise ConfigError(f"no {unknown[0]!r}; there are {', '.join(known)}")
    listed = [
        Job(name, source, seed, variant, (*group.size, *COMMON, *group.settings, *ours, *options.settings, *changes))
        for name, group in ((name, GROUPS[name]) for name in options.groups)
        for variant, changes in group.variants.items()
        if not options.variants or variant in options.variants
        for seed in options.seeds
        for source, ours in group.sources.items()
        if not options.sources or source in options.sources
        if source != "synthetic" or variant in SURFACE
    ]
    for job in listed:
        job.config()
    return listed


def finished(options: Options) -> dict[str, dict[str, Any]]:
    """Return the results of finished jobs of this code by key."""
    lines = options.file.read_text(encoding="utf-8").splitlines() if options.file.is_file() else []
    found = [json.loads(line) for line in lines]
    return {result["key"]: result for result in found if result["code"] == digest()}


def digest() -> str:
    """Return what identifies the code that runs."""
    return code_digest(Path(sigmasplat.__file__).parent, INSTALLED)


def measure(options: Options) -> dict[str, Any]:
    """Make the missing runs and store each at once; return the rows of all finished jobs, and how many are missing."""
    from claims_runs import rows

    listed, done = jobs_of(options), finished(options)
    options.runs.mkdir(parents=True, exist_ok=True)
    for number, job in enumerate(listed, 1):
        if job.key in done or options.collect:
            continue
        start, made = time.perf_counter(), record.commit()
        result = {"key": job.key, "code": digest(), **made, "rows": rows(job, REGISTRATIONS, PLATEAUS)}
        with options.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(result, allow_nan=False) + "\n")
        done[job.key] = result
        took_s = time.perf_counter() - start
        print(f"{number}/{len(listed)} {job.source}, {job.variant}, seed {job.seed}: {took_s:.0f} s", flush=True)
    there = [job for job in listed if job.key in done]
    runs = [
        {"source": job.source, "seed": job.seed, "commit": done[job.key]["commit"]} | row
        for job in there
        for row in done[job.key]["rows"]
    ]
    return {"runs": runs, "missing": len(listed) - len(there)}


def main(options: Options) -> int:
    """Run, write the results, print them; exit code 2 if the options are invalid."""
    try:
        figures = measure(options)
    except SigmaSplatError as problem:
        return program.refuse("claims", problem)
    settings = {"common": COMMON, "of_groups": {name: asdict(group) for name, group in GROUPS.items()}}
    print(tables.table(program.keep("claims", figures, options, options.seeds, **settings)))
    return 0


if __name__ == "__main__":
    program.start(main, Options, __doc__)
