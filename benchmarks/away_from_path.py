"""Score final maps away from the path, in the synthetic room: exact views up to 1 m and 30° off it.

Each run is `sigmasplat run` in its own process: of this checkout, and of another one if --before gives its command.
A run folder that is complete is read, not repeated, unless --fresh. PSNR is the mean of the views. A pixel is wrong if
its error (root mean square of the channels) is above 0.1. V declares it if 2·√V is above 0.1. A pixel was seen if an
image of the recording shows its surface, by the exact depth of both; no map knows the colour of the others. A spike is
a splat with an axis ratio above 20 and a footprint (three standard deviations on both sides) longer than 20 px.
Writes benchmarks/results/<name>-<machine>.json and prints a table.

example: python benchmarks/away_from_path.py --before ../before/.venv/bin/sigmasplat --seeds 0
"""

import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import program
import record
import torch
import tyro
from finished_run import aligned_poses
from numpy.typing import NDArray
from tables import Section

from sigmasplat.commands.options import Settings
from sigmasplat.config import InputConfig, RenderConfig
from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.frame import Frame
from sigmasplat.plugins.evaluation.metrics.trajectory import associate
from sigmasplat.plugins.evaluation.run_views import working_frame
from sigmasplat.plugins.sources.synthetic import open_synthetic
from sigmasplat.render import render
from sigmasplat.render.reference import project
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.types import Matrix

arg = tyro.conf.arg
ROOM = "synthetic:frames=200,noise=1,exposure_change=0,seed={seed}"
"""A different room for each seed. Exposure is steady, because the views away from the path have gain 1."""
AWAY_M, AWAY_RAD = np.array([0.6, 0.5, 0.6]), np.deg2rad([10.0, 27.0, 8.0])
"""At most 0.98 m and 29.9° off the path."""
WRONG, AXIS_RATIO, FOOTPRINT_PX = 0.1, 20.0, 20.0
SEEN_STRIDE, SAME_SURFACE = 4, 0.03
"""Every fourth image of the recording decides what was seen; depths of one surface differ by less, a share of depth."""
COLUMNS = (
    ("PSNR, dB", "psnr_db", 2, 1.0),
    ("wrong pixels, %", "wrong", 1, 100.0),
    ("never seen, %", "unseen", 1, 100.0),
    ("seen and wrong, %", "seen_wrong", 2, 100.0),
    ("of these declared, %", "declared", 1, 100.0),
    ("right pixels declared, %", "false", 1, 100.0),
    ("spikes per view", "spikes", 1, 1.0),
    ("splats", "splats", 0, 1.0),
)
RUNS = record.ROOT / "runs" / "bench" / "away"


@dataclass(frozen=True)
class Options:
    """Score final maps away from the path, in the synthetic room."""

    before: Annotated[str, arg(help="command of another checkout to compare with")] = ""
    seeds: Annotated[tuple[int, ...], arg(help="random seeds; each is another room")] = (0, 1, 2)
    views: Annotated[int, arg(help="number of views")] = 60
    settings: Settings = ()
    limit: Annotated[int | None, arg(help="number of frames at most", help_behavior_hint="(default: all)")] = None
    name: Annotated[str, arg(help="name of the results; use another name with other --set")] = "away_from_path"
    fresh: Annotated[bool, arg(help="repeat runs that exist already")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def measure(options: Options) -> dict[str, Any]:
    """Run and score each checkout with each seed."""
    commands = {"this checkout": [sys.executable, "-m", "sigmasplat.cli"]}
    if options.before:
        commands["before"] = shlex.split(options.before)
    runs = [
        {"code": code, "seed": seed, **scores(finished_run(options, code, command, seed), options, seed)}
        for seed in options.seeds
        for code, command in commands.items()
    ]
    return {"runs": runs}


def finished_run(options: Options, code: str, command: list[str], seed: int) -> RunFolder:
    """Return the run of a checkout; it is repeated if it is not complete."""
    folder = options.runs / f"{record.slug(options.name)}-{record.slug(code)}-seed{seed}"
    facts = folder / "run.json"
    if options.fresh or not facts.is_file() or json.loads(facts.read_text())["status"] != "complete":
        words = [*command, "run", ROOM.format(seed=seed), "--seed", str(seed), "--out", str(folder), "--overwrite"]
        words += [word for setting in options.settings for word in ("--set", setting)]
        environment = program.environment_of(other=code == "before")
        words += ["--limit", str(options.limit)] if options.limit else []
        subprocess.run(words, check=True, env=environment)
    return RunFolder.open(folder)


def scores(run: RunFolder, options: Options, seed: int) -> dict[str, float]:
    """Return the mean scores of the views of a run."""
    recorded = json.loads((run.path / "config.json").read_text())  # another checkout can have other settings
    known = InputConfig.__dataclass_fields__
    settings = InputConfig(**{name: value for name, value in recorded["input"].items() if name in known})
    near_m = float(recorded["render"]["near_m"])
    room, path, field = open_synthetic(ROOM.format(seed=seed)), run.read_trajectory(), run.read_map()
    truth, away = room.truth(), room.views_away(options.views, AWAY_M, AWAY_RAD)
    matched, true_rows = associate(path.timestamps_s, truth.timestamps_s)
    T_estimate_truth = aligned_poses(truth.T_world_camera[true_rows], path.T_world_camera[matched])
    poses = away.truth()
    assert poses is not None
    recorded_views = [
        (working_frame(room, settings, i), truth.T_world_camera[i]) for i in range(0, len(room), SEEN_STRIDE)
    ]
    rows = []
    for i, T in enumerate(poses.T_world_camera):
        frame = working_frame(away, settings, i)
        wrong, row = view_scores(field, frame, se3.inverse(T_estimate_truth @ T), near_m)
        known = seen(frame, T, recorded_views)
        rows.append(row | {"unseen": float((~known).mean()), "seen_wrong": float((wrong & known).mean())})
    means = {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}
    return means | {"splats": len(field)}


def seen(frame: Frame, T_world_camera: Matrix, recorded: Sequence[tuple[Frame, Matrix]]) -> NDArray[np.bool_]:
    """Return which pixels [H, W] of a view show a surface that one of the recorded views shows too."""
    camera, found = frame.camera, np.zeros(frame.depth_m.size, bool)
    points = (camera.rays().astype(np.float64) * frame.depth_m[..., None]).reshape(-1, 3)
    points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    for other, T in recorded:
        x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
        rows = np.flatnonzero(~found & (z > 0.0))
        u = np.rint(x[rows] / z[rows] * camera.fx + camera.cx)
        v = np.rint(y[rows] / z[rows] * camera.fy + camera.cy)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        rows, u, v = rows[inside], u[inside].astype(int), v[inside].astype(int)
        found[rows] = np.abs(other.depth_m[v, u] - z[rows]) < SAME_SURFACE * z[rows]
    return found.reshape(frame.depth_m.shape)


def view_scores(
    field: GaussianField, frame: Frame, T_camera_world: Matrix, near_m: float
) -> tuple[NDArray[np.bool_], dict[str, float]]:
    """Return the wrong pixels [H, W] of one view, and its scores: shares in [0, 1], nan without pixels of a kind."""
    shown = render(field, frame.camera, T_camera_world)
    squared = (shown.color.clamp(0.0, 1.0).numpy() - frame.color) ** 2
    wrong = np.sqrt(squared.mean(-1)) > WRONG
    declared = 2.0 * shown.variance.mean(-1).clamp(min=0.0).sqrt().numpy() > WRONG
    return wrong, {
        "psnr_db": -10.0 * float(np.log10(squared.mean())),
        "wrong": float(wrong.mean()),
        "declared": float(declared[wrong].mean()) if wrong.any() else float("nan"),
        "false": float(declared[~wrong].mean()) if not wrong.all() else float("nan"),
        "spikes": float(spikes(field, frame.camera, T_camera_world, near_m).sum()),
    }


def spikes(field: GaussianField, camera: Camera, T_camera_world: Matrix, near_m: float) -> np.ndarray:
    """Return which splats, bool [N], are spikes in a view: those with their centre in the image, a ratio of longest to
    shortest axis above `AXIS_RATIO`, and a footprint longer than `FOOTPRINT_PX`."""
    T = torch.as_tensor(T_camera_world).to(field.params)
    p = project(field.means, field.quats, field.scales, T, camera, RenderConfig(depth="center"))
    ratio = field.scales.amax(1) / field.scales.amin(1)
    l1, l2, l3 = (
        column.double().clamp(min=1e-12) if k != 1 else column.double() for k, column in enumerate(p.conics.T)
    )
    var_v = 1.0 / l3**2
    var_u = (l2**2 * var_v + 1.0) / l1**2
    half = 0.5 * (var_u + var_v)
    largest = half + (half**2 - var_v / l1**2).clamp(min=0.0).sqrt()  # of the eigenvalues of the covariance
    u, v = p.means2d.T
    inside = (p.z > near_m) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.asarray(inside & (ratio > AXIS_RATIO) & (6.0 * largest.sqrt() > FOOTPRINT_PX))


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return a table with one row per checkout: means of the seeds."""
    runs = measured["figures"]["runs"]
    shown = [column for column in COLUMNS if all(column[1] in run for run in runs)]  # older results have fewer
    rows = list[list[str]]()
    for code in dict.fromkeys(run["code"] for run in runs):
        of_code = [run for run in runs if run["code"] == code]
        means = {key: float(np.mean([run[key] for run in of_code])) for _, key, _, _ in shown}
        rows.append([code, *(f"{scale * means[key]:.{digits}f}" for _, key, digits, scale in shown)])
    seeds = len({run["seed"] for run in runs})
    note = f"Mean of {seeds} rooms, {measured['config']['views']} views each."
    return [Section("Away from the path", ["code", *(head for head, _, _, _ in shown)], rows, note)]


def main(options: Options) -> int:
    """Measure, write the results, print them."""
    return program.run("away_from_path", options, measure, options.seeds)


if __name__ == "__main__":
    program.start(main, Options)
