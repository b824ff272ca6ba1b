"""Score meshes against a reference surface: this checkout, an earlier one, and Open3D's TSDF with our poses.

The reference is the true surface of the synthetic room, else a surface fused from true depth and true poses. Every
sequence is run once with this checkout and, with --before, once with another one. Open3D fuses the sensor's depth of
all frames at full size with the poses of our run; it needs a Python of its own (--open3d). All of it is repeated for
each seed. A finished run of --before in --runs is used again.
Writes benchmarks/results/<name>-<machine>.json and prints a table.

example: python benchmarks/mesh_quality.py --before ../before/.venv/bin/sigmasplat --open3d ../peers/bin/python
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import peers
import record
import tables
import tyro
from accuracy_tables import spread
from tables import Section

from sigmasplat.data import se3
from sigmasplat.data.mesh import Mesh, mesh_depth
from sigmasplat.data.trajectory import Trajectory, evenly_spread
from sigmasplat.errors import SigmaSplatError
from sigmasplat.final.tsdf import Tsdf, extract_surface
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.reconstruction import (
    BEHIND_M,
    SLACK_M,
    correct,
    distances,
    visible_points,
)
from sigmasplat.plugins.evaluation.metrics.trajectory import align_rigid, ate, pair_poses
from sigmasplat.plugins.outputs.mesh_files import read_mesh
from sigmasplat.plugins.sources import open_source
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.types import Matrix

arg = tyro.conf.arg
Result = dict[str, Any]
SOURCES = ("synthetic:frames=150,noise=1", "livingroom")
POINTS, VIEWS, REFERENCE_FRAMES, LARGEST_EDGE_M, FAR_M = 60_000, 40, 60, 0.05, 0.05
OURS, ALL, BEFORE = "this checkout", "this checkout, --triangles 0", "before"


@dataclass(frozen=True)
class Options:
    """Score meshes against a reference surface."""

    sources: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = SOURCES
    before: Annotated[
        Path | None,
        arg(help="the sigmasplat program of an earlier checkout", help_behavior_hint="(default: left out)"),
    ] = None
    open3d: Annotated[Path | None, arg(help="a Python with open3d", help_behavior_hint="(default: left out)")] = None
    voxels_m: Annotated[tuple[float, ...], arg(help="edges of Open3D's voxels, m")] = (0.01, 0.0058)
    limit: Annotated[int, arg(help="frames at most")] = 150
    width: Annotated[int, arg(help="width of our working images, pixels")] = 320
    seeds: Annotated[tuple[int, ...], arg(help="random seeds, one run of each checkout for each")] = (0, 1, 2)
    name: Annotated[str, arg(help="name of the results")] = "mesh-quality"
    runs: Annotated[Path, arg(help="folder of the runs and meshes")] = accuracy.RUNS / "mesh-quality"
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


@dataclass(frozen=True, eq=False)
class Reference:
    """A surface in the frame of the truth, of the faces that were seen, and true poses with the depth it has there."""

    surface: Mesh
    views: list[tuple[Matrix, Matrix]]
    exact: bool


def program(words: list[str], log: Path, other: bool = False) -> None:
    """Run a command, with `other` that of another checkout. Raises SigmaSplatError with its last line if it fails."""
    problem, _ = accuracy.call(words, log, other)
    if problem is not None:
        raise SigmaSplatError(f"{' '.join(words[:4])} … failed: {problem}; see {log}")


def finished_run(
    command: list[str], path: str, folder: Path, options: Options, seed: int, other: bool = False
) -> RunFolder:
    """Run SLAM with a program; with `other`, that of another checkout, return the finished run if the folder has it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    done = (folder / "run.json").exists() and json.loads((folder / "run.json").read_text())["status"] == "complete"
    if not (done and other):
        words = ["run", path, "--limit", str(options.limit), "--set", f"input.width={options.width}"]
        words += ["--seed", str(seed), "--out", str(folder), "--overwrite", "--no-eval"]
        program([*command, *words], folder.with_suffix(".log"), other)
    return RunFolder.open(folder)


def true_path_of(source: Source, path: Trajectory) -> tuple[Trajectory, Trajectory]:
    """Return the poses that a path and the truth share, ours and true. Raises SigmaSplatError without a truth."""
    truth = source.truth()
    if truth is None:
        raise SigmaSplatError(f"{source.name} has no true poses")
    ours, theirs = pair_poses(path, truth)
    times = np.arange(float(len(ours)))
    return Trajectory(times, ours), Trajectory(times, theirs)


def reference_of(path: str, source: Source, options: Options) -> Reference:
    """Return the true surface of a sequence, or fuse one, and keep the faces that its frames see."""
    truth, exact = source.truth(), source.true_surface()
    assert truth is not None
    rows = evenly_spread(range(min(options.limit, len(source), len(truth))), REFERENCE_FRAMES)
    if exact is None:
        volume = Tsdf(0.01, 0.04)
        for i in rows:
            frame = source.frame(i).prepared(0, 0.1, 8.0)
            volume.integrate(frame.depth_m, frame.color, frame.camera, truth.T_world_camera[i])
        surface = extract_surface(volume)
    else:
        surface = exact.subdivided(LARGEST_EDGE_M)
    camera = source.camera.prepared(options.width)
    centers, seen, views = surface.corners.mean(1), np.zeros(len(surface.faces), bool), []
    for i in evenly_spread(rows, VIEWS):
        T = truth.T_world_camera[i]
        depth_m, face = mesh_depth(surface, camera, se3.inverse(T))
        seen[face[face >= 0]] = True
        seen |= visible_points(centers, depth_m, camera, T, SLACK_M)
        views.append((T, depth_m))
    return Reference(surface.with_faces(seen), views, exact is not None)


def scores(mesh: Mesh, reference: Reference, source: Source, T_truth_world: Matrix, options: Options) -> Result:
    """Return the scores of a mesh in the world of a run; lengths in m.

    A face counts if it is in a view, at most `BEHIND_M` behind the reference, where the reference has a surface.
    """
    camera, found = source.camera.prepared(options.width), mesh.moved(T_truth_world)
    centers, seen = found.corners.mean(1), np.zeros(len(found.faces), bool)
    for T, depth_m in reference.views:
        seen |= visible_points(centers, np.where(depth_m > 0, depth_m, np.float32(-1e3)), camera, T, BEHIND_M)
    ours = found.with_faces(seen)
    to_truth = distances(ours.sampled(POINTS, 0), reference.surface)
    to_found = distances(reference.surface.sampled(POINTS, 1), ours)
    return {
        "accuracy_m": float(to_truth.mean()), "completion_m": float(to_found.mean()), **correct(to_truth, to_found),
        "far_share": float((to_truth > FAR_M).mean()), "triangles": len(mesh.faces),
    }  # fmt: skip


def open3d_meshes(source: Source, path: Trajectory, folder: Path, options: Options) -> dict[str, Mesh]:
    """Fuse the sensor's depth of all frames by Open3D with the poses of a run; return a mesh per size of voxel."""
    made: dict[str, Mesh] = {}
    if options.open3d is None:
        return made
    with tempfile.TemporaryDirectory(prefix="mesh-quality-") as name:
        frames = Path(name)
        peers.write_frames(source, options.limit, frames)
        times = np.load(frames / "times.npy")
        poses = np.full((len(times), 4, 4), np.nan)
        rows = np.searchsorted(path.timestamps_s, times).clip(0, len(path) - 1)
        known = np.abs(path.timestamps_s[rows] - times) < 1e-6
        poses[known] = path.T_world_camera[rows[known]]
        np.save(frames / "poses.npy", poses)
        for voxel_m in options.voxels_m:
            peer = Path(__file__).parent / "peer_open3d_mesh.py"
            program([str(options.open3d), str(peer), str(frames), str(voxel_m)], folder / "open3d.log")
            made[f"Open3D, voxels of {1e3 * voxel_m:g} mm"] = read_mesh(frames / f"open3d-{voxel_m:g}.ply")
    return made


def measure(name: str, options: Options) -> list[Result]:
    """Return the scores of all meshes of one sequence, for each seed."""
    path = accuracy.located(name)
    source = open_source(path)
    reference = reference_of(path, source, options)
    return [row for seed in options.seeds for row in measured_with(seed, name, source, reference, options)]


def measured_with(seed: int, name: str, source: Source, reference: Reference, options: Options) -> list[Result]:
    """Run all checkouts on one sequence with a seed; return the scores of their meshes, and of Open3D's."""
    path, made = accuracy.located(name), []
    folder = options.runs / f"{record.slug(Path(name).name)}-seed{seed}"
    commands = {OURS: [sys.executable, "-m", "sigmasplat"]}
    commands |= {BEFORE: [str(options.before)]} if options.before else {}
    for label, command in commands.items():
        run = finished_run(command, path, folder / label.replace(" ", "-"), options, seed, other=label == BEFORE)
        ours = run.read_frames().path
        pair = true_path_of(source, ours)
        T_truth_world = align_rigid(pair[0].T_world_camera[:, :3, 3], pair[1].T_world_camera[:, :3, 3])
        meshes = {}
        wanted = {OURS: ["--axes", "camera"], ALL: ["--axes", "camera", "--triangles", "0"]}
        for mesh, words in (wanted if label == OURS else {BEFORE: []}).items():
            file = folder / f"{record.slug(mesh)}.ply"
            words = [*command, "mesh", str(run.path), "--out", str(file), "--overwrite", *words]
            program(words, folder / "mesh.log", other=label == BEFORE)
            meshes[mesh] = read_mesh(file)
        if label == OURS:
            meshes |= open3d_meshes(source, ours, folder, options)
        facts = {"source": Path(name).name, "seed": seed, "exact": reference.exact, "ate_m": ate(*pair).rmse_m}
        for mesh, found in meshes.items():
            made.append(facts | {"mesh": mesh} | scores(found, reference, source, T_truth_world, options))
            print(json.dumps(made[-1]), file=sys.stderr, flush=True)
    return made


COLUMNS = (
    "mesh", "ATE, mm", "accuracy, mm", "completion, mm", "precision, %", "recall, %", "F1, %", "off by > 5 cm, %",
    "triangles",
)  # fmt: skip
NOTE = (
    "Accuracy: mean distance of the mesh to the reference; completion: of the reference to the mesh; precision, recall "
    "and F1: within 1 cm. Only parts that the frames see count. The reference is the true surface of the synthetic "
    "room, else a surface fused from true depth and true poses. Open3D fuses the sensor's depth of all frames with the "
    "poses of this checkout."
)


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return a table per sequence: mean ± standard deviation over the seeds."""
    made, meshes = [], measured["figures"]["meshes"]
    for source in dict.fromkeys(row["source"] for row in meshes):
        kinds = dict.fromkeys(row["mesh"] for row in meshes if row["source"] == source)
        of = {kind: [row for row in meshes if (row["source"], row["mesh"]) == (source, kind)] for kind in kinds}
        rows = [
            [kind, *(spread([1e3 * row[name] for row in of[kind]]) for name in ("ate_m", "accuracy_m", "completion_m")),
             *(spread([100 * row[name] for row in of[kind]]) for name in ("precision", "recall", "f1", "far_share")),
             f"{round(np.mean([row['triangles'] for row in of[kind]])):,}"]
            for kind in kinds
        ]  # fmt: skip
        made.append(Section(source, COLUMNS, rows, NOTE))
    return made


def main(options: Options) -> int:
    """Measure, write, print; return exit code 2 if a run or an option is invalid."""
    try:
        record.refuse_unwritable(options.out)
        meshes = [row for name in options.sources for row in measure(name, options)]
    except (SigmaSplatError, subprocess.SubprocessError) as problem:
        print(f"mesh_quality.py: {problem}", file=sys.stderr)
        return 2
    config = {name: value for name, value in asdict(options).items() if name in ("sources", "limit", "width")}
    measured = record.results("mesh_quality", {"meshes": meshes}, name=options.name, seeds=options.seeds, config=config)
    print(record.write(measured, options.out), file=sys.stderr)
    print(tables.table(measured))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,))))
