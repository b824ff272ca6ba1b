"""Write and read the folder of a run, which is valid at any time."""

import zlib
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.data.field import GaussianField
from sigmasplat.data.trajectory import Component, Trajectory
from sigmasplat.errors import RunError
from sigmasplat.files import machine
from sigmasplat.files.atomic import part_of, remove_leftovers, sync_file, write_text
from sigmasplat.files.json_files import append_line, read_json, read_lines, write_json
from sigmasplat.files.lock import LOCK, locked, no_warning
from sigmasplat.files.reading import refuse_special
from sigmasplat.files.tensors import open_tensors, write_tensors
from sigmasplat.input.lists import read_poses
from sigmasplat.run_folder import map_files, splat_ply as ply, trajectory as tum
from sigmasplat.run_folder.frames import RunFrames
from sigmasplat.run_folder.run_values import FACTS, REMEDY, Named, check_fields, check_log
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty, SplatStd

PROGRAM = "sigmasplat"
TRUTH = "truth.txt"
"""The true path in the run's world, written by an evaluation if the truth is known."""
MESH = "mesh.ply"
"""The surface, written by `sigmasplat mesh`."""
STATE = "state.safetensors"
"""The state from which an unfinished run resumes."""
FILES = (
    "config.json", "trajectory.txt", "map.ply", "checkpoint.safetensors", "log.jsonl", "loops.json",
    "metrics.json", "report.html", TRUTH, map_files.UNCERTAINTY_JSON, map_files.UNCERTAINTY_TENSORS,
)  # fmt: skip
"""Files that a run may have in addition to run.json, which always exists and identifies the folder as ours."""
COMPONENTS = "components"
"""Components that are not connected to the world."""
FIRST_FILES = {part_of(Path("run.json")).name, LOCK}
"""The only files of a run that was killed before run.json."""

Value = TypeVar("Value")


def _reads(name: str, read: Callable[[Path], Value]) -> Callable[["RunFolder"], Value]:
    """Return a method that reads a file of a run. It raises RunError if the file is missing."""

    def method(run: "RunFolder") -> Value:
        return read(run._existing(name))

    return method


def _writes(name: str, write: Callable[[Path, Value], None]) -> Callable[["RunFolder", Value], None]:
    """Return a method that writes a file of a run. It raises RunError if the file cannot be written."""

    def method(run: "RunFolder", value: Value) -> None:
        write(run.path / name, value)

    return method


@dataclass(frozen=True)
class RunFolder:
    """One run on disk: config.json, run.json (source, version, machine, status), log.jsonl (one line per frame),
    trajectory.txt, map.ply, checkpoint.safetensors, loops.json, metrics.json, report.html, submaps/, components/.

    Files are replaced atomically, and the log grows by complete lines, so an interrupted run can still be read.
    """

    path: Path

    @staticmethod
    def create(path: Path, config: Config, source_name: str, overwrite: bool = False) -> "RunFolder":
        """Start a run in a new or empty folder; with `overwrite`, remove the files of an earlier run first.

        Raises RunError if the folder has other content or cannot be written.
        """
        run = RunFolder(Path(path))
        facts = {
            "program": PROGRAM, "version": machine.package_version(), "code": machine.code_version(),
            "source": source_name, "machine": machine.describe(), "status": "running",
        }  # fmt: skip
        try:
            run.refuse_taken(run.path, overwrite)
            run.path.mkdir(parents=True, exist_ok=True)
            # First of all files: a run that is killed at any time leaves a folder that the next run can overwrite.
            write_json(run.path / "run.json", facts)
            run._clear()
        except OSError as problem:
            reason = problem.strerror or problem
            raise RunError(f"cannot write output {path}: {reason}; choose a writable --out") from problem
        write_json(run.path / "config.json", config.to_dict())
        return run

    @staticmethod
    def open(path: Path) -> "RunFolder":
        """Open the folder of an existing run. Raises RunError, with the missing files, if it is not one."""
        run = RunFolder(Path(path))
        if not run.path.is_dir():
            raise RunError(f"no run folder {path}; `sigmasplat run` creates one")
        missing = [name for name in ("config.json", "run.json") if not (run.path / name).is_file()]
        if missing:
            raise RunError(f"{path} is not a run folder: no {' and no '.join(missing)}")
        run._refuse_unless_ours()
        return run

    @staticmethod
    def refuse_taken(path: Path, overwrite: bool) -> None:
        """Raise RunError if a new run cannot have this folder: it has other content, or a run that must be kept."""
        if path.exists() and not path.is_dir():
            raise RunError(f"output {path} is a file; give a folder")
        if not path.is_dir() or all(entry.name in FIRST_FILES for entry in path.iterdir()):
            return
        if not overwrite:
            raise RunError(
                f"output {path} exists and is not empty; give another --out, or --overwrite to replace its run"
            )
        try:
            if not (path / "run.json").is_file():
                raise RunError(f"{path} is not a run folder: no run.json")
            RunFolder(path)._refuse_unless_ours()
        except RunError as problem:
            raise RunError(f"not overwriting {path}: {problem}; give another --out") from problem

    def _refuse_unless_ours(self) -> None:
        if self.facts().get("program") != PROGRAM:
            raise RunError(f"{self.path} is not a run folder: run.json was written by another program")

    def _clear(self) -> None:
        """Remove the files of an earlier run, and keep files that the user added."""
        for name in (*FILES, MESH, STATE):
            (self.path / name).unlink(missing_ok=True)
        self.remove_leftovers()
        self.submaps.clear()
        self.write_components(())

    @property
    def submaps(self) -> DiskStore:
        """Return the store of finished submaps, submaps/; it is empty if the run has a single map."""
        return DiskStore(self.path / "submaps")

    @property
    def state(self) -> Path:
        """Return the path of the state from which an unfinished run resumes."""
        return self.path / STATE

    def config(self) -> Config:
        """Read the settings of the run. Raises ConfigError if they cannot be read."""
        return Config.load(self.path / "config.json")

    facts = _reads("run.json", lambda path: check_fields(_object(path), FACTS, (), path))
    """Read run.json: source, version, machine, status and facts of `note`. Raises RunError if it is damaged."""

    def note(self, **facts: Any) -> None:
        """Add or change facts in run.json, for instance status="complete" or "interrupted", wall_s=…"""
        write_json(self.path / "run.json", self.facts() | facts)

    def locked(self, warn: Callable[[str], None] = no_warning) -> AbstractContextManager[None]:
        """Hold the run while a block writes to it. Raises RunError if another process holds it (`files.lock`)."""
        return locked(self.path, warn)

    def remove_leftovers(self) -> None:
        """Remove temporary files of killed processes, and the state of a complete run."""
        remove_leftovers(self.path, self.submaps.folder, *(self.path / COMPONENTS).glob("*"))
        if self.facts().get("status") == "complete":
            self.state.unlink(missing_ok=True)

    log = _writes("log.jsonl", append_line)
    """Append one line to log.jsonl."""
    read_log = _reads("log.jsonl", lambda path: check_log(read_lines(path), path))
    """Read the lines of log.jsonl; an incomplete last line, left by an interruption, is skipped. Raises RunError if
    another line is damaged or has a wrong value."""

    def sync_log(self) -> None:
        """Wait until the lines of log.jsonl are on the disk. Raises RunError if they cannot be written."""
        sync_file(self.path / "log.jsonl")

    def write_loops(self, records: Iterable[dict[str, Any]]) -> None:
        """Write loops.json: all tried pairs of submaps with their latest results."""
        write_json(self.path / "loops.json", iter(records))

    def read_loops(self) -> list[dict[str, Any]]:
        """Read loops.json; the list is empty if there is no such file. Raises RunError if it is damaged."""
        path = self.path / "loops.json"
        loops = read_json(path) if path.is_file() else []
        if not isinstance(loops, list) or not all(isinstance(loop, dict) for loop in loops):
            raise RunError(f"{path} is not a list of loops")
        return loops

    write_trajectory = _writes("trajectory.txt", tum.write_trajectory)
    """Write trajectory.txt: the valid poses (TUM text, T_world_camera)."""
    read_trajectory = _reads("trajectory.txt", partial(read_poses, may_be_empty=True))
    """Read trajectory.txt; it is empty if no pose is valid. Raises SourceError if it is damaged."""

    def read_frames(self) -> RunFrames:
        """Read log.jsonl and trajectory.txt together: the state of each frame at the end of the run, and its pose.
        Raises RunError or SourceError as `read_log` and `read_trajectory` do.
        """
        return RunFrames.of(self.read_log(), self.read_trajectory())

    write_components = _writes(COMPONENTS, map_files.write_components)
    """Write components/, the path and map of each component that is not connected to the world; remove others."""

    def component_numbers(self) -> list[int]:
        """Return the numbers of the components that are not connected to the world, in ascending order."""
        return map_files.component_numbers(self.path / COMPONENTS)

    def read_component(self, number: int) -> Component:
        """Read a component from components/. Raises RunError if a file is missing, SourceError if it is damaged."""
        trajectory, field = (self._existing(f"{COMPONENTS}/{number}/{name}") for name in map_files.COMPONENT_FILES)
        return Component(number, ply.read_field(field), read_poses(trajectory))

    write_map = _writes("map.ply", ply.write_field)
    """Write map.ply (3DGS PLY, world frame)."""
    read_map = _reads("map.ply", ply.read_field)
    """Read map.ply. Raises SourceError if it is damaged."""
    map_bytes = _reads("map.ply", lambda path: path.stat().st_size)
    """Return the size of map.ply."""
    write_uncertainty = _writes("", map_files.write_uncertainty)
    """Write uncertainty.json and uncertainty.safetensors: how sure map.ply is."""

    def read_uncertainty(self) -> MapUncertainty | None:
        """Return how sure map.ply is; None if the run has not measured it. Raises RunError if a file is damaged."""
        return map_files.read_uncertainty(self.path)

    def read_splat_std(self) -> tuple[GaussianField, SplatStd] | None:
        """Return map.ply and the standard deviations of its splats; None if the run has not measured them.

        Raises RunError if a file is damaged, or does not have one row for each splat; SourceError as `read_map` does.
        """
        if not (self.path / map_files.UNCERTAINTY_JSON).is_file():
            return None
        field = self.read_map()
        uncertainty = self.uncertainty_of(field)
        return None if uncertainty is None or uncertainty.std is None else (field, uncertainty.std)

    def uncertainty_of(self, field: GaussianField) -> MapUncertainty | None:
        """Return how sure `field`, the map of the run, is; None if the run has not measured it.

        Raises RunError if a file is damaged, or does not have one row for each splat.
        """
        uncertainty = self.read_uncertainty()
        if uncertainty is not None:
            map_files.refuse_misfit(self.path, uncertainty, len(field))
        return uncertainty

    def write_checkpoint(self, tensors: dict[str, Tensor], text: dict[str, str]) -> None:
        """Write checkpoint.safetensors: named tensors and text. Its checksum is noted in run.json."""
        write_tensors(path := self.path / "checkpoint.safetensors", tensors, text)
        self.note(checkpoint=_checksum(path))

    def read_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, str]]:
        """Read checkpoint.safetensors: tensors and text. Raises RunError if it is missing, damaged, or not that of
        run.json; so its tensors need no other checks."""
        path = self._existing("checkpoint.safetensors")
        refuse_special(path, RunError)
        if (noted := self.facts().get("checkpoint")) != _checksum(path):
            why = "its checksum is not that in run.json" if noted else "run.json does not have its checksum"
            raise RunError(f"checkpoint {path} is damaged: {why}; {REMEDY}")
        with open_tensors(path, "checkpoint") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return Named(tensors, path, "tensor"), file.metadata() or {}

    def read_odometry(self) -> Trajectory | None:
        """Return the path of tracking alone, without loop closure; None if the run has no such path or no loop.

        Raises RunError if the checkpoint is missing or damaged.
        """
        if not any(loop["accepted"] for loop in self.read_loops()):
            return None
        tensors, _ = self.read_checkpoint()
        poses = tensors.get("T_world_camera_odometry")
        return None if poses is None else Trajectory(tensors["timestamps_s"].numpy(), poses.numpy())

    write_metrics = _writes("metrics.json", write_json)
    """Write metrics.json; nan and inf become null."""
    read_metrics = _reads("metrics.json", lambda path: _object(path))
    """Read metrics.json. Raises RunError if it is damaged."""
    write_report = _writes("report.html", write_text)
    """Write report.html."""

    def _existing(self, name: str) -> Path:
        if not (self.path / name).is_file():
            raise RunError(f"run {self.path} has no {name}; did it stop before writing it? run it again")
        return self.path / name


def _checksum(path: Path) -> str:
    return f"{zlib.crc32(path.read_bytes()):08x}"


def _object(path: Path) -> dict[str, Any]:
    values = read_json(path)
    if not isinstance(values, dict):
        raise RunError(f"{path} is not a JSON object")
    return values
