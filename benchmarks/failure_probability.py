"""Judge the probability that a pose is off by more than 5 cm (graph/confidence.py).

The data are disturbed recordings with known truth, kept by benchmarks/robustness.py --keep DIR. Writes
benchmarks/results/<name>-<machine>.json.

example: python benchmarks/failure_probability.py --data runs/kept
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import tables
import tyro
from numpy.typing import NDArray
from robustness_scores import auroc
from tables import Section, significant

from sigmasplat.plugins.evaluation.metrics.trajectory import OFF_M, brier

arg = tyro.conf.arg
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Judge the probability that a pose is off by more than 5 cm."""

    data: Annotated[Path, arg(help="folder of robustness.py --keep")]
    name: Annotated[str, arg(help="name of the results")] = "failure-probability"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True, eq=False)
class Samples:
    """Stated probability that a frame that is not lost is off [N], whether it is [N], its sequence [N], and whether
    lost frames are off [L]."""

    p_off: Values
    off: NDArray[np.bool_]
    sequence: NDArray[np.str_]
    lost_off: NDArray[np.bool_]


def samples_of(folder: Path) -> Samples:
    """Read the kept runs. Raises OSError or ValueError if a file is missing or damaged."""
    p_off, off, sequence, lost_off = list[float](), list[bool](), list[str](), list[bool]()
    for path in sorted(folder.glob("*.npz")):
        error_m = np.load(path)["error_tracked_m"]
        for line in path.with_suffix(".jsonl").read_text().splitlines():
            frame = json.loads(line)
            error = error_m[frame["index"]]
            if not frame["tracking"] or not np.isfinite(error) or frame["component"]:
                continue
            if frame["lost"]:
                lost_off.append(error > OFF_M)
                continue
            p_off.append(frame["p_off"])
            off.append(error > OFF_M)
            sequence.append(path.name.partition("-")[0])
    return Samples(np.array(p_off), np.array(off), np.array(sequence), np.array(lost_off))


def judged(p: Values, off: NDArray[np.bool_]) -> dict[str, Any]:
    """Return AUROC, Brier score, and mean probability against share of frames that are off."""
    means = {"off": float(off.mean()), "mean": float(p.mean())}
    return {"frames": len(off), **means, "auroc": auroc(p, off), "brier": brier(p, off)}


def main(options: Options) -> int:
    """Judge each sequence, write and print."""
    s = samples_of(options.data)
    of_each = {name: s.sequence == name for name in np.unique(s.sequence).tolist()}
    of_sequences = {name: judged(s.p_off[rows], s.off[rows]) for name, rows in of_each.items()}
    found = {
        "lost": float(s.lost_off.mean()) if len(s.lost_off) else None, "of_sequences": of_sequences,
        "all": judged(s.p_off, s.off),
    }  # fmt: skip
    measured = program.keep("failure_probability", found, options, data=options.data.name)
    print(tables.table(measured))
    return 0


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate how well the stated probabilities judge each sequence, and all."""
    measured = measured["figures"]
    rows = [
        [name, str(s["frames"]), f"{100 * s['off']:.2f} %", f"{100 * s['mean']:.2f} %",
         "–" if s["auroc"] is None else significant(s["auroc"]), significant(s["brier"])]
        for name, s in (measured["of_sequences"] | {"all": measured["all"]}).items()
    ]  # fmt: skip
    heads = ("sequence", "frames", "off by > 5 cm", "mean p_off", "AUROC", "Brier")
    return [Section("Tracked frames, without lost ones", heads, rows)]


if __name__ == "__main__":
    program.start(main, Options)
