"""Switch on the weights of σ² one after the other, over sequences and seeds, and keep what every run was worth.

The likelihood that trains σ² is on in every variant but the one without variance: so each has a map of V, and they
differ by nothing but its use. Seed k stands for the same world and the same random numbers in every variant.
"""

import json
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sigmasplat
from sigmasplat.config import Config
from sigmasplat.config.text import full_path, override, split_settings
from sigmasplat.errors import ConfigError, RunError
from sigmasplat.io import machine
from sigmasplat.io.atomic import write_text
from sigmasplat.io.machine import INSTALLED, code_digest
from sigmasplat.presets import preset as preset_of

if TYPE_CHECKING:
    from sigmasplat.run.terminal import Screen

WEIGHTS = ("tracking.uncertainty", "loops.uncertainty", "registration.uncertainty", "final.uncertainty")
TAUS = ("tracking.tau", "loops.tau", "registration.tau")
RESERVED = {*WEIGHTS, *TAUS, "seed"}
NAMES = ("none", "+tracking", "+loop", "+registration", "+final")
WITHOUT_VARIANCE = "without variance"
VARIANTS: dict[str, dict[str, str]] = {
    name: {weight: str(i < used) for i, weight in enumerate(WEIGHTS)} for used, name in enumerate(NAMES)
}
"""Settings of each variant: in order, each weight on from its own variant onwards; the last is beyond the paper."""
VARIANTS[WITHOUT_VARIANCE] = VARIANTS["none"] | {"mapping.weight_nll_color": "0", "mapping.weight_nll_depth": "0"}
COMPARED = (
    ("none", WITHOUT_VARIANCE), ("+tracking", "none"), ("+loop", "+tracking"), ("+registration", "+loop"),
    ("+registration", "none"), ("+final", "+registration"),
)  # fmt: skip
"""Which variant is judged against which."""
MADE_BY = "sigmasplat bench ablation"
SEED = "{seed}"


@dataclass(frozen=True)
class Job:
    """One run: the sequence as asked for and as opened, the variant, the seed, all settings."""

    source: str
    path: str
    variant: str
    seed: int
    config: Config

    @property
    def key(self) -> tuple[str, str, int]:
        """Return what tells the runs of one file apart."""
        return self.path, self.variant, self.seed

    @property
    def folder(self) -> str:
        """Return a name for the run's folder."""
        return re.sub(r"[^a-z0-9]+", "-", f"{self.path} {self.variant} seed{self.seed}".lower()).strip("-")


Runner = Callable[[Job, Path], Mapping[str, Any]]
"""Carries out a job in a new folder and returns the run's metrics."""


@dataclass(frozen=True)
class Study:
    """What is to be compared: sequences, each with every variant and seeds 0, 1, …; settings common to all."""

    sources: Sequence[str]
    config: Config
    seeds: int = 3
    limit: int | None = None
    without_variance: bool = False

    @property
    def variants(self) -> list[str]:
        """List the variants in the order of the table."""
        return [*[WITHOUT_VARIANCE] * self.without_variance, *NAMES]

    def jobs(self, source: str) -> list[Job]:
        """List the runs of a sequence, all variants of a seed before the next seed; {seed} becomes the number."""
        return [
            Job(
                source, full_path(source.replace(SEED, str(seed))), variant, seed,
                override(self.config, VARIANTS[variant] | {"seed": str(seed), "input.limit": str(self.limit or 0)}),
            )
            for seed in range(self.seeds)
            for variant in self.variants
        ]  # fmt: skip

    def circumstances(self) -> dict[str, Any]:
        """Return what must be equal for runs to be of one ablation: settings, length, code, machine."""
        return {
            "config": self.config.to_dict(),
            "limit": self.limit,
            "code": code_digest(Path(sigmasplat.__file__).parent, INSTALLED),
            "machine": machine.describe(),
        }


def common_config(preset: str, settings: Sequence[str], tau: float) -> Config:
    """Return a preset's settings with those of --set, and one τ in every weight.

    Raises ConfigError on a setting that the ablation changes itself, and where no variance would be learned.
    """
    given = split_settings(settings)
    for name in sorted(RESERVED & given.keys()):
        raise ConfigError(f"the ablation sets {name} itself; leave it out (τ is --tau, the number of seeds --seeds)")
    if not tau > 0:
        raise ConfigError(f"--tau must be above 0, found {tau:g}")
    config = override(preset_of(preset), given | dict.fromkeys(TAUS, str(tau)))
    if not config.mapping.weight_nll_color:
        raise ConfigError(f"{preset} learns no variance: mapping.weight_nll_color is 0; give a preset where it is not")
    return config


class Results:
    """The JSON file of an ablation: circumstances, then one entry a run; replaced whole after each of them."""

    def __init__(self, path: Path, study: Study, overwrite: bool = False) -> None:
        """Take up a file where it stopped, or start one, in memory; `overwrite` drops runs that are not of the study.

        Raises RunError where runs would be dropped without it, or the file is not one of ours.
        """
        self.path = path
        self.head = json.loads(json.dumps({"made_by": MADE_BY} | study.circumstances()))
        planned = {job.key for source in study.sources for job in study.jobs(source)}
        there = _read(path) if path.exists() else {"runs": []}
        same = all(there.get(name) == value for name, value in self.head.items())
        self.runs = [run for run in there["runs"] if same and _key(run) in planned]
        dropped = len(there["runs"]) - len(self.runs)
        if dropped and not overwrite:
            reason = "that are not asked for now" if same else "with other settings or code, or from another machine"
            raise RunError(f"{path} holds runs ({dropped}) {reason}; give another --out, or --overwrite to drop them")

    def find(self, job: Job) -> dict[str, Any] | None:
        """Return a job's finished run, None if there is none."""
        return next((run for run in self.runs if _key(run) == job.key), None)

    def add(self, job: Job, metrics: Mapping[str, Any], wall_s: float) -> None:
        """Keep a run and write the file. Raises RunError if it cannot be written."""
        from sigmasplat.evaluation.paired_comparison import figures_of

        self.runs.append(
            {
                "source": job.source, "path": job.path, "variant": job.variant, "seed": job.seed,
                "settings": VARIANTS[job.variant], "commit": machine.code_version(),
                "date": datetime.now(UTC).isoformat(timespec="seconds"), "wall_s": round(wall_s, 2),
                "figures": figures_of(metrics), "metrics": dict(metrics),
            }
        )  # fmt: skip
        self.write()

    def write(self) -> None:
        """Write the file. Raises RunError if it cannot be written."""
        write_text(self.path, json.dumps(self.head | {"runs": self.runs}, indent=1, ensure_ascii=False) + "\n")

    def of(self, source: str) -> list[dict[str, Any]]:
        """List the runs of a sequence."""
        return [run for run in self.runs if run["source"] == source]


def _key(run: Mapping[str, Any]) -> tuple[str, str, int]:
    return run["path"], run["variant"], run["seed"]


def _read(path: Path) -> dict[str, Any]:
    """Read an ablation's file. Raises RunError if it is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise RunError(f"cannot go on with {path}: {problem}; give another --out") from problem
    if not isinstance(found, dict) or found.get("made_by") != MADE_BY or not isinstance(found.get("runs"), list):
        raise RunError(f"{path} is not the file of an ablation; give another --out")
    return found


def carry_out(
    jobs: Sequence[Job], results: Results, runner: Runner, keep: Path | None, tell: Callable[[Job], None]
) -> None:
    """Run the jobs that have no result yet, in order, and keep each at once; run folders stay only in `keep`."""
    for job in (job for job in jobs if results.find(job) is None):
        tell(job)
        start = time.perf_counter()
        with _folder(job, keep) as folder:
            metrics = runner(job, folder)
        results.add(job, metrics, time.perf_counter() - start)


@contextmanager
def _folder(job: Job, keep: Path | None) -> Iterator[Path]:
    """Yield where a job's run folder may be made."""
    if keep:
        yield keep / job.folder
        return
    with tempfile.TemporaryDirectory(prefix="sigmasplat-ablation-") as temporary:
        yield Path(temporary) / job.folder


def perform(job: Job, folder: Path, screen: "Screen") -> dict[str, Any]:
    """Run SLAM as a job says, score the run, and return its metrics.

    Raises KeyboardInterrupt where Ctrl-C ended the run early: half a run is no result.
    """
    from sigmasplat.evaluation.evaluate import evaluate
    from sigmasplat.run.session import new_folder, record
    from sigmasplat.slam.slam import Slam
    from sigmasplat.sources import open_source

    source = open_source(job.path, job.config.input)
    run = new_folder(folder, job.config, source, True, source_path=job.path)
    with screen.steps(len(source)) as watch:
        outcome = record(Slam(job.config, run.submaps), source, run, watch)
    if outcome.status == "interrupted":
        raise KeyboardInterrupt
    with screen.counting("evaluation") as progress:
        evaluate(run, source, progress=progress)
    return run.read_metrics()
