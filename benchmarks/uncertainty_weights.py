"""Fit the weights that ship with `sigma` (`model.map_uncertainty.SHIPPED`) to several sequences, and measure how well
they transfer: fitted to all sequences but one, they are scored at views of the one that were held back.

Two kinds of views teach the weights, both without ground truth: probe views, and probe views of other submaps. The
latter are away from the keyframes of a submap, so they teach the part `extrapolated`. Samples of finished runs are kept
in runs/bench/uncertainty-weights and are not made again; use --fresh after a change of the code.
Writes benchmarks/results/<name>-<machine>.json; `python benchmarks/tables.py` writes its tables into the documents.

example: python benchmarks/uncertainty_weights.py --sources redkitchen livingroom synthetic --limit 60
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import tyro
from ablation import short
from finished_run import FinishedRun, run_slam
from numpy.typing import NDArray
from tables import Section, significant
from uncertainty import SOURCES, HoldEvery, MostViews, located
from uncertainty_samples import Study, study_config
from unseen_views import held_back_views

from sigmasplat.commands import options as described
from sigmasplat.commands.input_options import Limit
from sigmasplat.commands.options import prepare_torch
from sigmasplat.config.text import full_path
from sigmasplat.data import se3
from sigmasplat.final.refinement import KeyframeReader
from sigmasplat.final.uncertainty import FIRM, LIMIT, Samples, probe_samples, probe_views
from sigmasplat.fit.target import Keyframe, Target
from sigmasplat.plugins.evaluation.metrics.uncertainty import calibration_scores, z_scores
from sigmasplat.plugins.sources import open_source
from sigmasplat.render.backend import make_view
from sigmasplat.uncertainty.calibration import background_of, fit_weights, splat_residuals
from sigmasplat.uncertainty.map_uncertainty import COLOR_PARTS, DEPTH_PARTS, SHIPPED

arg = tyro.conf.arg
RUNS = record.ROOT / "runs" / "bench" / "uncertainty-weights"
TAUGHT_BY = tuple(name for name in SOURCES if "steady" not in name)
PARTS = {"color": COLOR_PARTS, "depth": DEPTH_PARTS}
PULLED_TO = {"color": SHIPPED.color, "depth": SHIPPED.depth}
PROBES, OTHER_SUBMAPS, HELD_BACK = "probes", "probes of other submaps", "held back"
SUBMAPS = 3
"""At most this many submaps of a run, evenly spread, are rendered at views of others."""
OTHERS = 6
"""Views of other submaps, the nearest in time, at which a submap is rendered."""
PIXELS = 20_000
"""Pixels of each sequence in a fit: all sequences count the same."""
SHARE = 0.25
"""Share of them at probe views of other submaps: most users look at a map near the path."""

Arrays = Mapping[str, NDArray[np.float64]]
Weights = dict[str, float]


@dataclass(frozen=True)
class Options:
    """Fit the weights of the parts of predicted variances to several sequences, and score them on the one left out."""

    sources: Annotated[tuple[str, ...], arg(help="sequences: names in the data folder, or paths")] = TAUGHT_BY
    settings: described.Settings = ("input.width=240",)
    limit: Limit = 100
    hold_every: HoldEvery = 8
    views: MostViews = 24
    name: Annotated[str, arg(help="name of the results")] = "uncertainty-weights"
    fresh: Annotated[bool, arg(help="make all samples again")] = False
    runs: Annotated[Path, arg(help="folder of samples of finished runs")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


# ---- samples ----


def samples_of(options: Options, source: str) -> Arrays:
    """Return the samples of a sequence, from its file or from a new run."""
    file = options.runs / f"{record.slug(f'{source} {options.limit} {options.settings}')}.npz"
    if file.is_file() and not options.fresh:
        with np.load(file) as stored:
            return dict(stored)
    study = Study((located(source),), study_config("sigma", options.settings), 1, options.limit, options.hold_every)
    (job,) = study.jobs()
    opened = open_source(full_path(job.path), job.config.input)
    run = run_slam(job.config, opened)
    held = list[tuple[int, Keyframe]]()
    for view in held_back_views(run, opened, options.views):
        # The weights are those of readings of the sensor; an exact depth is not a reading.
        frame = replace(view.frame, depth_m=np.zeros_like(view.frame.depth_m)) if view.exact else view.frame
        target = Target.of(frame, size_of(run))
        held.append((view.submap, Keyframe(frame.index, target, view.T_world_camera, fixed=True)))
    found = collected(run, held)
    options.runs.mkdir(parents=True, exist_ok=True)
    np.savez(file, **found)
    return found


def size_of(run: FinishedRun) -> tuple[int, int]:
    """Return rows and columns of the planes of a view."""
    alpha = make_view(run.config.backend, run.camera, run.config.render, variance=False).alpha
    return alpha.shape[0], alpha.shape[1]


def collected(run: FinishedRun, held: Sequence[tuple[int, Keyframe]]) -> Arrays:
    """Return "KIND|QUANTITY|parts" [K, P], "…|squared_error" [P, C] and "…|views" of a run's final map and submaps."""
    view = make_view(run.config.backend, run.camera, run.config.render, variance=False)
    whole = run.part(range(len(run.store)), refined=len(run.refined) == len(run.store))
    probes = list(probe_views(run.store, run.anchors, view))
    refined_probes = list(probe_views(whole, run.anchors, view))
    owner = [s for s in range(len(run.store)) for _ in run.store.load(s).probe_frames]
    samples = dict[str, list[tuple[Samples, Samples]]]()
    chosen = np.unique(np.linspace(0, len(run.store) - 1, SUBMAPS).round().astype(int)).tolist()
    for s in [None, *chosen]:
        field = run.field if s is None else run.store.load(s).field
        anchors = run.anchors if s is None else [np.eye(4)]
        keyframes = KeyframeReader(whole if s is None else run.part([s]), anchors, view)
        background = background_of(keyframes)
        splats = splat_residuals(field, keyframes, run.config.render, run.config.backend)
        T_map_world = np.eye(4) if s is None else se3.inverse(run.anchors[s])
        near = refined_probes if s is None else [p for p, of in zip(probes, owner, strict=True) if of == s]
        far = sorted((abs(of - s), i) for i, of in enumerate(owner) if s is not None and of != s)[:OTHERS]
        kinds = {
            PROBES: near,
            OTHER_SUBMAPS: [probes[i] for _, i in far],
            HELD_BACK: [keyframe for of, keyframe in held if s is None or of == s],
        }
        for kind, views in kinds.items():
            moved = [Keyframe(v.index, v.target, T_map_world @ v.T_world_camera, fixed=True) for v in views]
            samples.setdefault(kind, []).append(probe_samples(field, splats, background, moved, run.config))
    found = dict[str, NDArray[np.float64]]()
    for kind, pairs in samples.items():
        for number, quantity in enumerate(PARTS):
            joined = [pair[number].joined() for pair in pairs]
            found[f"{kind}|{quantity}|parts"] = np.concatenate([parts for parts, _ in joined], 1)
            found[f"{kind}|{quantity}|squared_error"] = np.concatenate(
                [errors for _, errors in joined if len(errors)] or [joined[0][1]]
            )
            found[f"{kind}|{quantity}|views"] = np.array(float(sum(pair[number].views for pair in pairs)))
    return found


# ---- fits ----


def fitted(sequences: Sequence[Arrays], quantity: str) -> Weights:
    """Return the weights with the highest likelihood on several sequences, each with the same number of pixels."""
    planes, errors = list[NDArray[np.float64]](), list[NDArray[np.float64]]()
    views, random = 0.0, np.random.default_rng(0)
    for arrays in sequences:
        for kind, share in ((PROBES, 1.0 - SHARE), (OTHER_SUBMAPS, SHARE)):
            squared = arrays[f"{kind}|{quantity}|squared_error"]
            if len(squared):
                rows = random.choice(len(squared), round(PIXELS * share))
                planes.append(arrays[f"{kind}|{quantity}|parts"][:, rows])
                errors.append(squared[rows].mean(1))
            views += float(arrays[f"{kind}|{quantity}|views"])
    parts = dict(zip(PARTS[quantity], np.concatenate(planes, 1), strict=True))
    return fit_weights(parts, np.concatenate(errors), PULLED_TO[quantity], round(views), LIMIT)


def own_weights(arrays: Arrays, quantity: str, weights: Weights) -> Weights:
    """Return weights after a fit to the run's own probe views."""
    parts = dict(zip(PARTS[quantity], arrays[f"{PROBES}|{quantity}|parts"], strict=True))
    views = round(float(arrays[f"{PROBES}|{quantity}|views"]))
    return fit_weights(parts, arrays[f"{PROBES}|{quantity}|squared_error"].mean(1), weights, views, LIMIT, FIRM)


def variance_of(arrays: Arrays, quantity: str, kind: str, weights: Weights) -> NDArray[np.float64]:
    """Return the weighted sum of the parts [P] at views of one kind."""
    return np.array([weights[name] for name in PARTS[quantity]]) @ arrays[f"{kind}|{quantity}|parts"]


def temperature(sequences: Sequence[Arrays], quantity: str, weights: Weights) -> float:
    """Return the temperature (`Calibration`): the geometric mean of 1 and of the factor of V with which 68 % of the
    errors at probe views are within one standard deviation; mean over the sequences."""
    logs = list[float]()
    for arrays in sequences:
        variance = variance_of(arrays, quantity, PROBES, own_weights(arrays, quantity, weights))
        squared = arrays[f"{PROBES}|{quantity}|squared_error"]
        logs.append(float(np.log(z_scores(variance, squared, 0.0)["z_68"])))
    return float(np.exp(np.mean(logs)))


def scored(
    arrays: Arrays, quantity: str, kind: str, weights: Weights, calibrated: bool, scale: float
) -> dict[str, float]:
    """Return the scores of weights at views of one kind; calibrated: after a fit to the run's own probe views, and
    times the temperature `scale`."""
    own = own_weights(arrays, quantity, weights) if calibrated else weights
    variance = (scale if calibrated else 1.0) * variance_of(arrays, quantity, kind, own)
    found = calibration_scores(variance, arrays[f"{kind}|{quantity}|squared_error"], 0.0)
    return {name: found[name] for name in ("nll", "auce", "coverage_68", "coverage_95")}


def measure(options: Options) -> dict[str, Any]:
    """Fit to all sequences and to all but one, and score both on each sequence."""
    prepare_torch()
    sequences = {short(source): samples_of(options, source) for source in options.sources}
    every = list(sequences.values())
    shipped = {quantity: fitted(every, quantity) for quantity in PARTS}
    temperatures = {quantity: temperature(every, quantity, weights) for quantity, weights in shipped.items()}
    rows = []
    for source, arrays in sequences.items():
        others = [other for name, other in sequences.items() if name != source]
        for quantity in PARTS:
            of_others = fitted(others or [arrays], quantity)
            choices = {
                "all": (shipped[quantity], temperatures[quantity]),
                "others": (of_others, temperature(others or [arrays], quantity, of_others)),
            }
            rows += [
                {"source": source, "quantity": quantity, "views": kind, "calibrated": calibrated}
                | {"temperature_of_others": choices["others"][1]}
                | {fit: scored(arrays, quantity, kind, of[0], calibrated, of[1]) for fit, of in choices.items()}
                for kind in (HELD_BACK, OTHER_SUBMAPS)
                for calibrated in (False, True)
                if len(arrays[f"{kind}|{quantity}|squared_error"])
            ]
    return {"weights": shipped, "temperatures": temperatures, "scores": rows}


# ---- tables ----


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the weights, and a table for each quantity of how well weights of other sequences do."""
    figures = measured["figures"]
    names = list(dict.fromkeys(name for weights in figures["weights"].values() for name in weights))
    weights = [
        [
            quantity.replace("color", "colour"), *(f"{of[name]:.2g}" if name in of else "–" for name in names),
            f"{figures['temperatures'][quantity]:.2f}",
        ]
        for quantity, of in figures["weights"].items()
    ]  # fmt: skip
    made = [Section("Weights fitted to all sequences", ["quantity", *names, "temperature"], weights)]
    for quantity in figures["weights"]:
        rows = [cells(row) for row in figures["scores"] if row["quantity"] == quantity]
        head = ["sequence", "views", "fit to its probes", "NLL", "… fitted to the others"]
        head += ["AUCE", "… fitted to the others", "68 %, fitted to the others", "95 %, …"]
        made.append(Section(f"Weights of {quantity.replace('color', 'colour')}", head, rows))
    return made


def cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a row of scores."""
    every, others = row["all"], row["others"]
    percent = [significant(100.0 * others[name], 2) for name in ("coverage_68", "coverage_95")]
    pairs = [significant(of[name]) for name in ("nll", "auce") for of in (every, others)]
    return [row["source"], row["views"], "yes" if row["calibrated"] else "no", *pairs, *percent]


def main(options: Options) -> int:
    """Fit, write the results, print them; return the exit code."""
    return program.run("uncertainty_weights", options, measure, [0])


if __name__ == "__main__":
    program.start(main, Options)
