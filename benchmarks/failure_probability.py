"""Fit the probability that a pose is off by more than 5 cm (graph/confidence.py).

The data are disturbed recordings with known truth, kept by benchmarks/robustness.py --keep DIR. A model that is fitted
to all sequences but one is judged on that one. Writes benchmarks/results/<name>-<machine>.json and prints the standard
deviation at which a place is as likely off as not, which belongs into confidence.py.

example: python benchmarks/failure_probability.py --data runs/kept
"""

import json
from collections.abc import Mapping
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
from scipy.optimize import minimize_scalar
from tables import Section, significant

from sigmasplat.graph.confidence import hop_wrong
from sigmasplat.plugins.evaluation.metrics.trajectory import OFF_M, brier

arg = tyro.conf.arg
Values = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Fit the weights of the probability that a pose is off by more than 5 cm."""

    data: Annotated[Path, arg(help="folder of robustness.py --keep")]
    name: Annotated[str, arg(help="name of the results")] = "failure-probability"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True, eq=False)
class Samples:
    """Probability that the fit of a frame that is not lost is wrong [N], standard deviation of its position [N] m,
    whether it is off [N], its sequence [N], and whether lost frames are off [L]."""

    hop: Values
    std_m: Values
    off: NDArray[np.bool_]
    sequence: NDArray[np.str_]
    lost_off: NDArray[np.bool_]

    def of(self, rows: NDArray[np.bool_]) -> "Samples":
        """Return some of the frames."""
        return Samples(self.hop[rows], self.std_m[rows], self.off[rows], self.sequence[rows], self.lost_off)


def samples_of(folder: Path) -> Samples:
    """Read the kept runs. Raises OSError or ValueError if a file is missing or damaged."""
    known, off, sequence, lost_off = list[tuple[float, float]](), list[bool](), list[str](), list[bool]()
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
            values = _plain(frame["tracking"])
            known.append((hop_wrong(values), values["position_std_m"]))
            off.append(error > OFF_M)
            sequence.append(path.name.partition("-")[0])
    return Samples(*np.array(known).T, np.array(off), np.array(sequence), np.array(lost_off))


def _plain(tracking: Mapping[str, float | None]) -> dict[str, float]:
    """Return the values of a log, in which null stands for NaN or inf."""
    return {name: float("nan") if value is None else value for name, value in tracking.items()}


def even_std_m(s: Samples) -> float:
    """Return the most likely standard deviation of a position that is as likely off as not, if a wrong fit or a wrong
    place puts a frame off."""

    def loss(log_m: float) -> float:
        p = np.clip(off_probability(float(np.exp(log_m)), s), 1e-9, 1.0 - 1e-9)
        return float(-np.log(np.where(s.off, p, 1.0 - p)).sum())

    return float(np.exp(minimize_scalar(loss, bounds=np.log((1e-3, 1e3)), method="bounded").x))


def off_probability(even_m: float, s: Samples) -> Values:
    """Return the probability of each frame to be off [N]."""
    return np.asarray(1.0 - (1.0 - s.hop) * even_m / (even_m + s.std_m))


def judged(p: Values, off: NDArray[np.bool_]) -> dict[str, Any]:
    """Return AUROC, Brier score, and mean probability against share of frames that are off."""
    means = {"off": float(off.mean()), "mean": float(p.mean())}
    return {"frames": len(off), **means, "auroc": auroc(p, off), "brier": brier(p, off)}


def main(options: Options) -> int:
    """Fit, judge each sequence by a model without it, write and print."""
    s, held_out = samples_of(options.data), {}
    for name in sorted(set(s.sequence.tolist())):
        test, others = s.of(s.sequence == name), s.of(s.sequence != name)
        held_out[name] = judged(off_probability(even_std_m(others), test), test.off)
    even_m = even_std_m(s)
    found = {
        "even_std_m": even_m,
        "lost": float(s.lost_off.mean()) if len(s.lost_off) else None, "held_out": held_out,
        "all": judged(off_probability(even_m, s), s.off),
    }  # fmt: skip
    measured = program.keep("failure_probability", found, options, data=options.data.name)
    print(tables.table(measured))
    return 0


def sections(measured: dict[str, Any]) -> list[Section]:
    """Tabulate the fitted value, and how well it judges sequences that it was not fitted to."""
    measured = measured["figures"]
    judgements = {f"{name}, fitted to the others": scores for name, scores in measured["held_out"].items()}
    rows = [
        [name, str(s["frames"]), f"{100 * s['off']:.2f} %", f"{100 * s['mean']:.2f} %",
         significant(s["auroc"]), significant(s["brier"])]
        for name, s in (judgements | {"all, fitted to all": measured["all"]}).items()
    ]  # fmt: skip
    return [
        Section("Place", ("as likely off as not, m",), [[significant(measured["even_std_m"])]]),
        Section(
            "Tracked frames, without lost ones",
            ("sequence", "frames", "off by > 5 cm", "mean p_off", "AUROC", "Brier"),
            rows,
        ),
    ]


if __name__ == "__main__":
    program.start(main, Options)
