"""Run SigmaSplat and other RGB-D systems on the same frames and score every path with the same evaluation.

Open3D and ORB-SLAM3 run in a Python of their own (--open3d, --orbslam3). Without it they are left out; with --keep the
rows of earlier results are kept. A path that any other system has written is scored with --paths.
Writes benchmarks/results/<name>-<machine>.json, prints tables.

example: python benchmarks/peers.py --open3d ../peers/bin/python --sources redkitchen cubicles
"""

import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import accuracy
import numpy as np
import program
import record
import tables
import tyro
from accuracy_tables import spread
from numpy.typing import NDArray
from peer_clock import SECONDS, TOTALS
from tables import Section

from sigmasplat.config.find_preset import default_preset, preset as preset_of
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import ConfigError, SigmaSplatError, SourceError
from sigmasplat.files.atomic import write_text
from sigmasplat.input.lists import read_poses
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.metrics.trajectory import ate, pair_poses
from sigmasplat.plugins.sources import open_source

arg = tyro.conf.arg
Result = dict[str, Any]
FOLDER = Path(__file__).parent
SOURCES = ("redkitchen", "livingroom", "cubicles", "hololens", "fr1_xyz", "cabinet58")
OURS = "SigmaSplat, `sigma`"


@dataclass(frozen=True)
class Peer:
    """Another system: its name, the package it comes in, and the arguments of peer_<package>.py."""

    name: str
    package: str
    method: str = ""
    more: tuple[str, ...] = ()


PEERS = (
    Peer("Open3D, odometry point-to-plane", "open3d", "point-to-plane"),
    Peer("Open3D, odometry hybrid", "open3d", "hybrid"),
    Peer("Open3D, dense SLAM", "open3d", "dense-slam"),
    Peer("ORB-SLAM3", "orbslam3"),
)
QUOTED: tuple[Result, ...] = (
    {"system": "RTAB-Map 0.23 †", "source": "redkitchen", "ate_m": 0.052},
    {"system": "RTAB-Map 0.23 †", "source": "livingroom", "ate_m": 0.023},
    {"system": "RTAB-Map 0.23 †", "source": "cubicles", "ate_m": 0.015},
    {"system": "RTAB-Map 0.23 †", "source": "hololens", "ate_m": 0.102, "with_pose": 0.37},
)
"""Figures that are not measured by this program."""


@dataclass(frozen=True, kw_only=True)
class OtherSystems:
    """The options of programs that run other systems: where these are, and how many frames they get."""

    open3d: Annotated[Path | None, arg(help="a Python with open3d", help_behavior_hint="(default: left out)")] = None
    orbslam3: Annotated[
        Path | None,
        arg(help="a Python with pyorbslam3 and opencv-python-headless", help_behavior_hint="(default: left out)"),
    ] = None
    vocabulary: Annotated[
        Path | None,
        arg(help="ORB-SLAM3's ORBvoc.txt", help_behavior_hint="(default: one is trained on each sequence)"),
    ] = None
    limit: Annotated[int | None, arg(help="frames at most", help_behavior_hint="(default: all)")] = None


@dataclass(frozen=True)
class Options(OtherSystems):
    """Run SigmaSplat and other RGB-D systems on the same frames and score every path with the same evaluation."""

    sources: Annotated[tuple[str, ...], arg(help="names in the data folder, or paths")] = SOURCES
    systems: Annotated[tuple[str, ...], arg(help="the other systems")] = tuple(p.method or p.package for p in PEERS)
    seeds: Annotated[tuple[int, ...], arg(help="starts of SigmaSplat's random numbers, a run each")] = (0,)
    paths: Annotated[
        tuple[str, ...],
        arg(help="SYSTEM=SEQUENCE=FILE: also score a TUM text file that another system has written", metavar="PATHS"),
    ] = ()
    keep: Annotated[bool, arg(help="keep the earlier results of other systems and sequences")] = False
    name: Annotated[str, arg(help="name of the results")] = "peers"
    fresh: Annotated[bool, arg(help="run also what has been run before")] = False
    runs: Annotated[Path, arg(help="folder of the run folders")] = accuracy.RUNS
    out: Annotated[Path, arg(help="folder of the results")] = record.RESULTS


def write_frames(source: Source, limit: int | None, folder: Path) -> None:
    """Write color.npy (uint8), depth.npy (float32, m), times.npy (s) and camera.json for another system to read.

    Frames keep their size; depth outside the range that SigmaSplat uses is 0.
    """
    settings, count = preset_of(default_preset()).input, frames_in(source, limit)
    times_s = []
    for i in range(count):
        frame = source.frame(i).prepared(0, settings.min_depth_m, settings.max_depth_m)
        if i == 0:
            camera, size = frame.camera, frame.depth_m.shape
            color = np.lib.format.open_memmap(folder / "color.npy", "w+", np.uint8, (count, *size, 3))
            depth = np.lib.format.open_memmap(folder / "depth.npy", "w+", np.float32, (count, *size))
        color[i], depth[i] = np.rint(frame.color * 255.0), frame.depth_m
        times_s.append(frame.timestamp_s)
    np.save(folder / "times.npy", times_s)
    (folder / "camera.json").write_text(json.dumps(asdict(camera)))


def frames_in(source: Source, limit: int | None) -> int:
    """Return how many frames of a sequence are used."""
    return min(len(source), limit or len(source))


def path_of(times_s: NDArray[np.float64], poses: NDArray[np.float64]) -> Trajectory:
    """Return the known poses [N, 4, 4] (the others are NaN), with rotations made exact by SVD."""
    there = np.isfinite(poses).all((1, 2))
    u, _, vt = np.linalg.svd(poses[there, :3, :3])
    exact = poses[there].copy()
    exact[:, :3, :3] = u @ vt
    return Trajectory(times_s[there], exact)


def score(path: Trajectory, source: Source, limit: int | None) -> dict[str, Any]:
    """Return frames, frames without a pose and ATE, None without poses. Raises SourceError without true poses."""
    truth = source.truth()
    if truth is None:
        raise SourceError(f"{source.name} has no true poses")
    frames = frames_in(source, limit)
    if not len(path):
        return {"frames": frames, "without_pose": frames, "ate_m": None}
    times_s = np.array([source.timestamp_s(i) for i in range(frames)])
    known, _ = pair_poses(Trajectory(times_s, np.tile(np.eye(4), (frames, 1, 1))), path)
    found = ate(path, truth)
    return {"frames": frames, "without_pose": frames - len(known), "ate_m": found.rmse_m, "ate_max_m": found.max_m}


def run_ours(options: Options) -> list[Result]:
    """Run SigmaSplat as `accuracy.py` does; return a result per run."""
    # Poses are final when the refinement of the map begins, so it is left out.
    settings = ("final.iterations=0",)
    wanted = accuracy.Options(options.sources, seeds=options.seeds, settings=settings, limit=options.limit)
    made = []
    for result in accuracy.run_all(accuracy.jobs_of(wanted), options):  # type: ignore[arg-type]
        figures, found = result["figures"], {"system": OURS, "source": result["job"]["source"]}
        kept = {"frames": figures.get("frames"), "without_pose": figures.get("lost"), "ate_m": figures.get("ate_m")}
        made.append({**found, "problem": result["problem"], **kept})
    return made


def pythons_of(options: OtherSystems) -> dict[str, Path | None]:
    """Return the Python of each package of other systems; None if these systems are left out."""
    return {"open3d": options.open3d, "orbslam3": options.orbslam3}


def run_peer(peer: Peer, name: str, path: str, frames: Path, options: OtherSystems, python: Path) -> Result:
    """Run one system on the frames in a folder and score its path; if it fails, the result has a `problem`."""
    words = [peer.method or str(options.vocabulary or frames / "vocabulary.txt"), *peer.more]
    for old in ("poses.npy", "version.txt", SECONDS, TOTALS):
        (frames / old).unlink(missing_ok=True)
    command = [str(python), str(FOLDER / f"peer_{peer.package}.py"), str(frames), *words]
    problem, _ = accuracy.call(command, frames / "output.txt")
    result: Result = {"system": peer.name, "source": name, "problem": problem}
    if problem is None:
        result["version"] = (frames / "version.txt").read_text().strip()
        try:
            estimate = path_of(np.load(frames / "times.npy"), np.load(frames / "poses.npy"))
            result |= score(estimate, open_source(path), options.limit)
        except SigmaSplatError as wrong:
            result["problem"] = str(wrong)
    return result


def finished(peer: Peer, path: str, options: Options) -> tuple[Path, Result, Result | None]:
    """Return the file of a peer's result, its key, and the result of an earlier run with an equal key."""
    program = (FOLDER / f"peer_{peer.package}.py").read_bytes()
    given = {"path": path, "limit": options.limit, "method": peer.method, "vocabulary": str(options.vocabulary)}
    key = given | {"program": sha256(program).hexdigest()}
    kept = options.runs / f"peer-{record.slug(f'{Path(path).name} {peer.name}')}.json"
    earlier = record.read(kept) if kept.exists() and not options.fresh else {}
    return kept, key, earlier["result"] if earlier.get("key") == key else None


def run_peers(options: Options) -> list[Result]:
    """Run the other systems for which a Python is given, sequence by sequence."""
    pythons = pythons_of(options)
    wanted = [peer for peer in PEERS if (peer.method or peer.package) in options.systems]
    chosen = [(peer, python) for peer in wanted if (python := pythons[peer.package])]
    made = []
    for name in options.sources:
        path = accuracy.located(name)
        states = [(peer, python, *finished(peer, path, options)) for peer, python in chosen]
        with tempfile.TemporaryDirectory(prefix="peers-") as folder:
            if any(result is None for *_, result in states):
                write_frames(open_source(path), options.limit, Path(folder))
            for peer, python, kept, key, earlier in states:
                result = earlier or run_peer(peer, Path(name).name, path, Path(folder), options, python)
                if result["problem"] is None:
                    write_text(kept, json.dumps({"key": key, "result": result}, indent=1) + "\n")
                shown = result["problem"] or f"ATE {spread(_errors_cm([result]))} cm"
                print(f"{name}, {peer.name}: {shown}", file=sys.stderr, flush=True)
                made.append(result)
    return made


def read_paths(options: Options) -> list[Result]:
    """Score the paths written by other systems. Raises ConfigError or SourceError if a file is not a valid path."""
    made = []
    for text in options.paths:
        system, _, rest = text.partition("=")
        name, _, file = rest.rpartition("=")
        if not name:
            raise ConfigError(f"--paths {text}: expected SYSTEM=SEQUENCE=FILE")
        found = score(read_poses(Path(file)), open_source(accuracy.located(name)), options.limit)
        made.append({"system": system, "source": Path(name).name, "problem": None, **found})
    return made


def sections(measured: dict[str, Any]) -> list[Section]:
    """Return the tables of results: errors by system and sequence, and every run."""
    runs, quoted = measured["figures"]["runs"], measured["figures"]["quoted"]
    names = dict.fromkeys(run["source"] for run in runs)
    sources = [*(name for name in SOURCES if name in names), *(name for name in names if name not in SOURCES)]
    order = (OURS, *(peer.name for peer in PEERS))
    there = dict.fromkeys(run["system"] for run in [*runs, *quoted])
    systems = [*(name for name in order if name in there), *(name for name in there if name not in order)]
    rows = [_row(system, [*runs, *quoted], sources) for system in systems]
    commits = sorted({run["commit"][:9] for run in runs if run.get("commit")})
    note = NOTE + (f" Some results were kept from earlier runs, of commits {', '.join(commits)}." if commits else "")
    made = [Section("ATE in cm", ["system", *sources, "frames without a pose"], rows, note)]
    failed = [[f"{run['source']}, {run['system']}", str(run["problem"])] for run in runs if run["problem"]]
    return [*made, Section("Failed", ["run", "last words"], failed)] if failed else made


NOTE = (
    "ATE: root mean square over the frames that have a pose, after a rigid fit without scale. All systems get the same "
    "frames; SigmaSplat works at 320 pixels width, the others at full size. † Quoted, not measured by this command."
)


def _row(system: str, runs: list[Result], sources: list[str]) -> list[str]:
    """Return the row of one system: its error in each sequence, then the number of frames without a pose."""
    cells, without = [], []
    for source in sources:
        found = [r for r in runs if (r["system"], r["source"]) == (system, source)]
        cells.append(spread(_errors_cm(found)))
        counts = [run["without_pose"] for run in found if "without_pose" in run]
        shares = [run["with_pose"] for run in found if "with_pose" in run]
        if any(counts):
            without.append(f"{source} {spread(counts)} of {max(run.get('frames', 0) for run in found)}")
        without += [f"{source} {100 * (1 - share):.0f} %" for share in shares]
    known = any("without_pose" in run for run in runs if run["system"] == system)
    return [system, *cells, ", ".join(without) or ("0" if known else "–")]


def _errors_cm(runs: list[Result]) -> list[float]:
    return [100.0 * run["ate_m"] for run in runs if run.get("ate_m") is not None]


def kept_rows(options: Options, measured: set[tuple[str, str]]) -> list[Result]:
    """Return the earlier results of systems and sequences that were not measured now, with their commit."""
    earlier = record.latest(options.name, options.out)
    if earlier is None:
        raise ConfigError(f"--keep: {options.out} has no results {options.name!r}")
    rows = [row for row in earlier["figures"]["runs"] if (row["system"], row["source"]) not in measured]
    return [{"commit": earlier["commit"], **row} for row in rows]


def main(options: Options) -> int:
    """Run, score, write, print; return exit code 1 if a run failed, 2 if the options are invalid."""
    try:
        extra = read_paths(options)
        runs = [*run_ours(options), *run_peers(options), *extra]
        runs += kept_rows(options, {(run["system"], run["source"]) for run in runs}) if options.keep else []
    except SigmaSplatError as problem:
        print(f"peers.py: {problem}", file=sys.stderr)
        return 2
    names = {run["source"] for run in runs}
    figures = {"runs": runs, "quoted": [figure for figure in QUOTED if figure["source"] in names]}
    config = {n: v for n, v in asdict(options).items() if n in ("sources", "systems", "limit", "paths")}
    measured = record.results("peers", figures, name=options.name, seeds=options.seeds, config=config)
    print(record.write(measured, options.out), file=sys.stderr)
    print(tables.table(measured))
    return int(any(run["problem"] for run in runs))


if __name__ == "__main__":
    program.start(main, Options, __doc__)
