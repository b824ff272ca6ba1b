"""Compare the weights of σ² on four sequences as `sigmasplat bench ablation` does, and keep the result.

What has been run is in runs/bench/ablation/NAME.json and not run again while code and settings stay. Writes
benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` lays it out in the documents.

example: python benchmarks/ablation.py --sources redkitchen --seeds 1 --limit 200
"""

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import record
import tables
import tyro

from sigmasplat.commands import options as described
from sigmasplat.commands.bench import DEFAULT_PRESET, Ablation
from sigmasplat.errors import SigmaSplatError

arg = tyro.conf.arg
SYNTHETIC = "synthetic:frames=240,overrun=20,noise=1,drift=6,seed={seed}"
"""A room of its own for each seed, a sensor that drifts, and a walk that ends on its own beginning."""
SOURCES = ("synthetic", "livingroom", "redkitchen", "hololens")
RUNS = record.ROOT / "runs" / "bench" / "ablation"


@dataclass(frozen=True)
class Options:
    """Compare the weights of σ² on four sequences, and keep the result."""

    sources: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = SOURCES
    preset: described.PresetName = DEFAULT_PRESET
    settings: described.Settings = ()
    seeds: described.Seeds = 3
    tau: described.Tau = 10.0
    limit: described.Limit = None
    reference: Annotated[bool, arg(help="leave out the runs without variance", help_behavior_hint="")] = True
    name: Annotated[str, arg(help="name of the results; another one for other --set")] = "ablation"
    runs: Annotated[Path, arg(help="folder of what has been run")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS

    def working_file(self) -> Path:
        """Return where runs are kept as they finish."""
        return self.runs / f"{record.slug(self.name)}.json"

    def ablation(self) -> Ablation:
        """Return the command that does it; runs made with other settings or code are dropped."""
        sources = tuple(map(located, self.sources))
        return Ablation(
            sources, self.preset, self.settings, self.seeds, self.tau, self.limit, self.reference,
            self.working_file(), overwrite=True,
        )  # fmt: skip


def located(name: str) -> str:
    """Return the path of a sequence: in the data folder if it is there, else the name as it stands."""
    known = record.data_root() / name
    return SYNTHETIC if name == "synthetic" else str(known.resolve()) if known.is_dir() else name


def short(source: str) -> str:
    """Return a sequence's name for tables: its folder's, or the built-in one's without its options."""
    return Path(source.partition(":")[0]).name


def kept(results: dict[str, Any]) -> dict[str, Any]:
    """Return an ablation's file for the committed results: figures only, sequences by name, not by where they lie."""
    named = [run | {"source": short(run["source"]), "path": Path(run["path"]).name} for run in results["runs"]]
    runs = [{name: value for name, value in run.items() if name != "metrics"} for run in named]
    return {"config": results["config"], "runs": runs}


def main(options: Options) -> int:
    """Run, write, print; exit code 2 if the options mean nothing."""
    options.runs.mkdir(parents=True, exist_ok=True)
    try:
        options.ablation().run()
    except SigmaSplatError as problem:
        print(f"ablation.py: {problem}", file=sys.stderr)
        return 2
    config = {n: v for n, v in asdict(options).items() if n not in ("runs", "out")}
    figures = kept(record.read(options.working_file()))
    measured = record.results("ablation", figures, name=options.name, seeds=range(options.seeds), config=config)
    print(record.write(measured, options.out), file=sys.stderr)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, config=(tyro.conf.FlagCreatePairsOff,))))
