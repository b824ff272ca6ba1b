"""Enable the weights of σ² one by one, over sequences and seeds, and store the metrics of every run.

The likelihood that trains σ² is enabled in every variant except the one without variance. So each of these variants has
a map of V, and they differ only in how V is used. Seed k gives the same scene and random numbers in every variant.
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
from typing import Any

from paired_comparison import figures_of

import sigmasplat
from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset as preset_of
from sigmasplat.config.text import full_path, override, split_settings
from sigmasplat.errors import ConfigError, RunError
from sigmasplat.files import machine
from sigmasplat.files.atomic import write_text
from sigmasplat.files.machine import INSTALLED, code_digest
from sigmasplat.files.reading import guarded, read_text
from sigmasplat.plugins.evaluation import evaluate as evaluation
from sigmasplat.run.scene import open_scene
from sigmasplat.run.session import Session, new_folder
from sigmasplat.run.terminal import Screen
from sigmasplat.run_folder.run_values import check_fields
from sigmasplat.system.slam import Slam

WEIGHTS = ("tracking.uncertainty", "loops.uncertainty", "registration.uncertainty", "final.uncertainty")
TAUS = ("tracking.tau", "loops.tau", "registration.tau")
RESERVED = {*WEIGHTS, *TAUS, "seed"}
NAMES = ("none", "+tracking", "+loop", "+registration", "+final")
WITHOUT_VARIANCE = "without variance"
VARIANTS: dict[str, dict[str, str]] = {
    name: {weight: str(i < used) for i, weight in enumerate(WEIGHTS)} for used, name in enumerate(NAMES)
}
"""Settings of each variant. Each variant enables one more weight; the last weight, +final, is not in the paper."""
VARIANTS[WITHOUT_VARIANCE] = VARIANTS["none"] | {"mapping.weight_nll_color": "0", "mapping.weight_nll_depth": "0"}
COMPARED = (
    ("none", WITHOUT_VARIANCE), ("+tracking", "none"), ("+loop", "+tracking"), ("+registration", "+loop"),
    ("+registration", "none"), ("+final", "+registration"),
)  # fmt: skip
"""Pairs (variant, baseline) to compare."""
MADE_BY = "benchmarks/ablation.py"
SEED = "{seed}"


@dataclass(frozen=True)
class Job:
    """One run: the sequence as given and as opened, the variant, the seed, all settings; `given` names those that keep
    their values in every scene."""

    source: str
    path: str
    variant: str
    seed: int
    config: Config
    given: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, str, int]:
        """Return what identifies a run in the file."""
        return self.path, self.variant, self.seed

    @property
    def folder(self) -> str:
        """Return a name for the run's folder."""
        return re.sub(r"[^a-z0-9]+", "-", f"{self.path} {self.variant} seed{self.seed}".lower()).strip("-")


Runner = Callable[[Job, Path], Mapping[str, Any]]
"""Runs a job in a new folder and returns the run's metrics."""


@dataclass(frozen=True)
class Study:
    """What to compare: sequences, each with every variant and seeds 0, 1, …, and the settings that all runs share;
    `given` names those that keep their values in every scene."""

    sources: Sequence[str]
    config: Config
    seeds: int = 3
    limit: int | None = None
    without_variance: bool = False
    given: tuple[str, ...] = ()

    @property
    def variants(self) -> list[str]:
        """List the variants in the order of the table."""
        return [*[WITHOUT_VARIANCE] * self.without_variance, *NAMES]

    def jobs(self, source: str) -> list[Job]:
        """List the runs of a sequence, seed by seed with all variants; {seed} is replaced by the number."""
        return [
            Job(
                source, full_path(source.replace(SEED, str(seed))), variant, seed,
                override(self.config, VARIANTS[variant] | {"seed": str(seed), "input.limit": str(self.limit or 0)}),
                self.given,
            )
            for seed in range(self.seeds)
            for variant in self.variants
        ]  # fmt: skip

    def conditions(self) -> dict[str, Any]:
        """Return what all runs of an ablation must share: settings, length, code, machine."""
        return {
            "config": self.config.to_dict(),
            "given": sorted(self.given),
            "limit": self.limit,
            "code": code_digest(Path(sigmasplat.__file__).parent, INSTALLED),
            "machine": machine.describe(),
        }


def common_config(preset: str, settings: Sequence[str], tau: float) -> Config:
    """Return a preset's settings, changed by --set, with the same τ for every weight.

    Raises ConfigError for a setting that the ablation itself changes, or if no variance would be learned.
    """
    given = split_settings(settings)
    for name in sorted(RESERVED & given.keys()):
        raise ConfigError(
            f"the ablation itself sets {name}; remove it (use --tau for τ, --seeds for the number of seeds)"
        )
    if not tau > 0:
        raise ConfigError(f"--tau must be above 0, found {tau:g}")
    config = override(preset_of(preset), given | dict.fromkeys(TAUS, str(tau)))
    if not config.mapping.weight_nll_color:
        raise ConfigError(
            f"{preset} learns no variance, because mapping.weight_nll_color is 0; choose a preset that learns one"
        )
    return config


class Results:
    """The JSON file of an ablation: the conditions, then one entry per run; rewritten after each run."""

    def __init__(self, path: Path, study: Study) -> None:
        """Read the file if it exists; runs that do not belong to the study are dropped.

        Raises RunError if the file is not an ablation's.
        """
        self.path = path
        self.head = json.loads(json.dumps({"made_by": MADE_BY} | study.conditions()))
        planned = {job.key for source in study.sources for job in study.jobs(source)}
        stored = _read(path) if path.exists() else {"runs": []}
        same = all(stored.get(name) == value for name, value in self.head.items())
        self.runs = [run for run in stored["runs"] if same and _key(run) in planned]

    def find(self, job: Job) -> dict[str, Any] | None:
        """Return the stored run of a job, or None."""
        return next((run for run in self.runs if _key(run) == job.key), None)

    def add(self, job: Job, metrics: Mapping[str, Any], wall_s: float) -> None:
        """Add a run and write the file. Raises RunError if it cannot be written."""
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
    """Read the file of an ablation. Raises RunError if it cannot be read or is another file."""
    stored = {"source": str, "path": str, "variant": str, "seed": int, "wall_s": float,
              "figures": dict[str, float | bool | None]}  # fmt: skip
    content = read_text(path, RunError)
    with guarded(path, "give another --name", RunError):
        found = json.loads(content)
    if not isinstance(found, dict) or found.get("made_by") != MADE_BY or not isinstance(found.get("runs"), list):
        raise RunError(f"{path} is not a file of benchmarks/ablation.py; give another --name")
    for number, run in enumerate(found["runs"], 1):
        check_fields(run, stored, tuple(stored), f"{path}: run {number}")
    return found


def run_jobs(
    jobs: Sequence[Job], results: Results, runner: Runner, keep: Path | None, announce: Callable[[Job], None]
) -> None:
    """Run the jobs without a stored result in order, and store each result at once; run folders stay only in `keep`."""
    for job in (job for job in jobs if results.find(job) is None):
        announce(job)
        start = time.perf_counter()
        with _folder(job, keep) as folder:
            metrics = runner(job, folder)
        results.add(job, metrics, time.perf_counter() - start)


@contextmanager
def _folder(job: Job, keep: Path | None) -> Iterator[Path]:
    """Yield the path for a job's run folder."""
    if keep:
        yield keep / job.folder
        return
    with tempfile.TemporaryDirectory(prefix="sigmasplat-ablation-") as temporary:
        yield Path(temporary) / job.folder


def run_job(job: Job, folder: Path, screen: Screen) -> dict[str, Any]:
    """Run SLAM with a job's settings, score the run, and return its metrics.

    Raises KeyboardInterrupt if Ctrl-C stopped the run: its metrics would not be comparable.
    """
    source, config = open_scene(job.path, job.config, job.given)
    run = new_folder(folder, config, source, True, source_path=job.path)
    with screen.steps(len(source)) as callback:
        outcome = Session(Slam(config, run.submaps), source, run, [callback]).execute()
    if outcome.status == "interrupted":
        raise KeyboardInterrupt
    with screen.counting("evaluation") as progress:
        evaluation.evaluate(run, source, progress=progress)
    return run.read_metrics()
