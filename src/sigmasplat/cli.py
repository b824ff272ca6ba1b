"""Offer the command line: sigmasplat demo | run | eval | mesh | export | bench | doctor; torch loads where needed."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sigmasplat import env, options
from sigmasplat.benches import bench
from sigmasplat.errors import ConfigError, SigmaSplatError
from sigmasplat.options import absolute, configured, prepare_torch, refuse_existing, source_of
from sigmasplat.presets import default_preset

if TYPE_CHECKING:
    from sigmasplat.config import Config
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.screen import Screen
    from sigmasplat.sources.base import Source

OK, UNHEALTHY, REFUSED, INTERRUPTED = 0, 1, 2, 130
DEFAULT_PRESET = default_preset()
DEMO_FOLDER, DEMO_FRAMES = Path("runs/demo"), 120
DESCRIPTION = """RGB-D SLAM on 3D Gaussians that knows how sure it is.

Start with: sigmasplat demo, then: sigmasplat run PATH"""


def demo(
    frames: options.Frames = DEMO_FRAMES,
    preset: options.PresetName = DEFAULT_PRESET,
    settings: options.Settings = (),
    out: options.DemoFolder = DEMO_FOLDER,
    seed: options.Seed = None,
) -> int:
    """Run SLAM on a room made in code, against exact truth; replaces the last demo.

    example: sigmasplat demo --frames 40
    """
    if frames < 1:
        raise ConfigError(f"--frames must be at least 1, found {frames}")
    whole_walk = max(frames, DEMO_FRAMES)  # fewer frames are a part of the walk: a hurried one loses the tracker
    return run(f"synthetic:frames={whole_walk}", preset, settings, out, overwrite=True, limit=frames, seed=seed)


def run(
    path: options.SourcePath,
    preset: options.PresetName = DEFAULT_PRESET,
    settings: options.Settings = (),
    out: options.OutFolder = None,
    overwrite: options.Overwrite = False,
    limit: options.Limit = None,
    stride: options.Stride = 1,
    strict: options.Strict = False,
    seed: options.Seed = None,
    evaluate: options.Evaluate = True,
    profile: options.Profile = False,
) -> int:
    """Run SLAM on a sequence: trajectory, map, uncertainty, report.

    example: sigmasplat run data/kitchen --limit 200 --set input.width=480
    """
    from sigmasplat.screen import Screen
    from sigmasplat.session import new_folder
    from sigmasplat.sources import open_source
    from sigmasplat.sources.depth_check import depth_warning

    screen, config = Screen(), configured(preset, settings, seed)
    source = open_source(path, strict=strict, stride=stride, limit=limit)
    warning = depth_warning(source)
    if warning:
        screen.warn(warning)
    folder = new_folder(out, config, source, overwrite, source_path=absolute(path), stride=stride, limit=limit)
    screen.say(f"{source.name}: {len(source)} frames, {config.name} → {folder.path}")
    return _record(screen, config, source, folder, evaluate, profile)


def evaluate_run(run: options.RunPath, mesh: options.WithMesh = False, moved_to: options.MovedSource = None) -> int:
    """Score an earlier run again; replaces its metrics, pictures and report.

    example: sigmasplat eval runs/kitchen
    """
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.screen import Screen

    folder = RunFolder.open(run)
    source = source_of(folder, moved_to)
    prepare_torch()
    _evaluate(Screen(), folder, source, mesh)
    return OK


def make_mesh(
    run: options.RunPath,
    voxel_m: options.VoxelM = 0.01,
    out: options.MeshFile = None,
    overwrite: options.Overwrite = False,
    moved_to: options.MovedSource = None,
) -> int:
    """Make a surface of a run's map, coloured triangles, from what it shows at its keyframes.

    example: sigmasplat mesh runs/kitchen --out kitchen.glb
    """
    from sigmasplat.io.mesh import check_name, write_mesh
    from sigmasplat.io.runs import MESH, RunFolder
    from sigmasplat.screen import Screen
    from sigmasplat.surface import reconstruct

    screen, folder, target = Screen(), RunFolder.open(run), out or run / MESH
    check_name(target)
    refuse_existing(out, overwrite)
    source = source_of(folder, moved_to)
    prepare_torch()
    with screen.counting("surface") as progress:
        surface = reconstruct(folder, source.camera, voxel_m=voxel_m, progress=progress)
    write_mesh(target, surface)
    screen.say(f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles: {target}")
    return OK


def export(
    run: options.RunPath,
    out: options.OutFile = None,
    format: options.Format = None,
    overwrite: options.Overwrite = False,
) -> int:
    """Write a run's map as 3DGS PLY for SuperSplat and other viewers, or its path as TUM text.

    example: sigmasplat export runs/kitchen --out kitchen.ply
    """
    from sigmasplat.io import ply, trajectory
    from sigmasplat.io.runs import RunFolder

    folder = RunFolder.open(run)
    chosen = format or ("trajectory" if out and out.suffix == ".txt" else "ply")
    target = out or Path(folder.path.resolve().name + {"ply": ".ply", "trajectory": ".txt"}[chosen])
    refuse_existing(target, overwrite)
    if chosen == "ply":
        ply.write_field(target, folder.read_map())
    else:
        trajectory.write_trajectory(target, folder.read_trajectory())
    print(target)
    return OK


def doctor() -> int:
    """Examine the installation: versions, processor, kernels, self-test.

    exit code 1 if something is wrong; example: sigmasplat doctor
    """
    from sigmasplat.doctor import Finding, examine, verdict

    findings: list[Finding] = []
    for finding in examine():
        findings.append(finding)
        mark = {True: "ok  ", False: "FAIL", None: "    "}[finding.ok]
        print(f"{mark} {finding.name:<16}{finding.value}", flush=True)
    healthy, sentence = verdict(findings)
    print(sentence)
    return OK if healthy else UNHEALTHY


def _record(
    screen: "Screen", config: "Config", source: "Source", folder: "RunFolder", evaluate: bool, profile: bool
) -> int:
    """Run SLAM into the folder, then score it; return the exit code."""
    from sigmasplat.session import record
    from sigmasplat.slam.slam import Slam

    prepare_torch()
    with screen.steps(len(source)) as watch:
        outcome = record(Slam(config, folder.submaps), source, folder, watch)
    if profile:
        screen.profile(folder.read_profile())
    if source.skipped:
        images = "image" if len(source.skipped) == 1 else "images"
        screen.warn(f"{len(source.skipped)} unreadable {images} passed over (first: {source.skipped[0]})")
    if outcome.status == "interrupted":
        screen.say(f"interrupted after {outcome.counts()}; trajectory, map and checkpoint so far are in {folder.path}")
        return INTERRUPTED
    if evaluate:
        _evaluate(screen, folder, source)
    else:
        screen.say(f"{outcome.counts()}: {folder.path}")
    return OK


def _evaluate(screen: "Screen", folder: "RunFolder", source: "Source", mesh: bool = False) -> None:
    """Score the run, print the table, and where the report is: it exists even where the truth does not fit."""
    from sigmasplat.evaluate import evaluate

    try:
        with screen.counting("evaluation") as progress:
            metrics = evaluate(folder, source, mesh=mesh, progress=progress)
        screen.results(metrics)
    except Exception as problem:
        problem.add_note(f"the run is in {folder.path}")
        raise
    finally:
        report = folder.path / "report.html"
        if report.exists():
            screen.say(f"report: {report.resolve()}")


COMMANDS: dict[str, Callable[..., int]] = {
    "demo": demo,
    "run": run,
    "eval": evaluate_run,
    "mesh": make_mesh,
    "export": export,
    "bench": bench,
    "doctor": doctor,
}


def _obey(arguments: Sequence[str]) -> int:
    """Run the command that the arguments name; return the exit code."""
    code: int = tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="sigmasplat", description=DESCRIPTION, args=arguments, config=(tyro.conf.FlagCreatePairsOff,)
    )
    return code


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit: 0 done, 1 unhealthy (doctor), 2 refused (one line says why), 130 interrupted."""
    given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        env.switches()
        code = _obey(given)
    except SigmaSplatError as problem:
        print(f"sigmasplat: {problem}", file=sys.stderr)
        code = REFUSED
    except KeyboardInterrupt:
        print("sigmasplat: interrupted", file=sys.stderr)
        code = INTERRUPTED
    sys.exit(code)


if __name__ == "__main__":
    main()
