"""Keep everything a run leaves behind in one folder that is valid at every moment."""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.errors import RunError
from sigmasplat.io import machine, ply, trajectory as tum
from sigmasplat.io.atomic import replacing, write_text
from sigmasplat.model.field import GaussianField
from sigmasplat.model.trajectory import Trajectory

PROGRAM = "sigmasplat"
MESH = "mesh.ply"
"""What `sigmasplat mesh` adds."""
FILES = (
    "config.json", "run.json", "trajectory.txt", "map.ply", "checkpoint.safetensors", "log.jsonl", "metrics.json",
    "profile.json", "report.html",
)  # fmt: skip


@dataclass(frozen=True)
class RunFolder:
    """One run on disk: config.json, run.json (source, version, machine, status), log.jsonl (a line per frame),
    trajectory.txt, map.ply, checkpoint.safetensors, profile.json, metrics.json, report.html, images/.

    Every file but the log is replaced whole; the log grows by whole lines. So an interrupted run can still be read.
    """

    path: Path

    @staticmethod
    def create(path: Path, config: Config, source_name: str, overwrite: bool = False) -> "RunFolder":
        """Start a run in a new or empty folder; with `overwrite`, remove the files of an earlier run of ours first.

        Raises RunError if the place holds anything else or cannot be written.
        """
        run = RunFolder(Path(path))
        run._claim(overwrite)
        facts = {
            "program": PROGRAM,
            "version": machine.package_version(),
            "git_commit": machine.git_commit(),
            "source": source_name,
            "machine": machine.describe(),
            "status": "running",
        }
        run._write_json("run.json", facts)
        run._write_json("config.json", config.to_dict())
        return run

    @staticmethod
    def open(path: Path) -> "RunFolder":
        """Open the folder of an earlier run. Raises RunError if it is none, saying what is missing."""
        run = RunFolder(Path(path))
        if not run.path.is_dir():
            raise RunError(f"no run folder {path}; `sigmasplat run` makes one")
        missing = [name for name in ("config.json", "run.json") if not (run.path / name).is_file()]
        if missing:
            raise RunError(f"{path} is not a run folder of ours: no {' and no '.join(missing)}")
        if run.facts().get("program") != PROGRAM:
            raise RunError(f"{path} is not a run folder of ours: run.json was written by another program")
        return run

    def _claim(self, overwrite: bool) -> None:
        """Make the folder, empty of earlier runs. Raises RunError."""
        if self.path.exists() and not self.path.is_dir():
            raise RunError(f"output {self.path} is a file; give a folder")
        try:
            if self.path.is_dir() and any(self.path.iterdir()):
                self._clear(overwrite)
            self.images.mkdir(parents=True, exist_ok=True)
        except OSError as problem:
            reason = problem.strerror or problem
            raise RunError(f"cannot write output {self.path}: {reason}; choose a writable --output") from problem

    def _clear(self, overwrite: bool) -> None:
        """Remove an earlier run's files, and no others: what the user put beside them stays."""
        if not overwrite:
            raise RunError(
                f"output {self.path} exists and is not empty; give another --output, or --overwrite to replace its run"
            )
        try:
            RunFolder.open(self.path)
        except RunError as problem:
            raise RunError(f"not overwriting {self.path}: {problem}; give another --output") from problem
        for name in (*FILES, MESH):
            (self.path / name).unlink(missing_ok=True)
        for picture in self.images.glob("*.png"):
            picture.unlink()

    @property
    def images(self) -> Path:
        """Return the folder of pictures, images/."""
        return self.path / "images"

    def config(self) -> Config:
        """Read the settings of the run. Raises ConfigError if they cannot be read."""
        return Config.load(self.path / "config.json")

    def facts(self) -> dict[str, Any]:
        """Read run.json: source, version, machine, status and what `note` added. Raises RunError if it is damaged."""
        return self._read_json("run.json")

    def note(self, **facts: Any) -> None:
        """Add or change facts in run.json, for instance status="complete" or "interrupted", wall_s=…"""
        self._write_json("run.json", self.facts() | facts)

    def log(self, record: dict[str, Any]) -> None:
        """Append one line to log.jsonl; it is on its way to disk when this returns. Raises RunError if not writable."""
        line = json.dumps(plain(record), allow_nan=False) + "\n"
        try:
            with (self.path / "log.jsonl").open("a", encoding="utf-8") as file:
                file.write(line)
        except OSError as problem:
            raise RunError(f"cannot write {self.path / 'log.jsonl'}: {problem.strerror or problem}") from problem

    def read_log(self) -> list[dict[str, Any]]:
        """Read the lines of log.jsonl; a last line cut off by an interruption is passed over.

        Raises RunError if it is missing or another line is damaged.
        """
        *whole, _cut_off = self._text("log.jsonl").split("\n")
        records = []
        for number, line in enumerate(whole, 1):
            try:
                records.append(json.loads(line))
            except json.JSONDecodeError as problem:
                raise RunError(f"{self.path / 'log.jsonl'}:{number}: not JSON: {line[:60]!r}") from problem
        return records

    def write_trajectory(self, trajectory: Trajectory) -> None:
        """Write trajectory.txt (TUM text, T_world_camera)."""
        tum.write_trajectory(self.path / "trajectory.txt", trajectory)

    def read_trajectory(self) -> Trajectory:
        """Read trajectory.txt. Raises RunError if it is missing, SourceError if it is damaged."""
        return tum.read_trajectory(self._existing("trajectory.txt"))

    def write_map(self, field: GaussianField) -> None:
        """Write map.ply (3DGS PLY, world frame)."""
        ply.write_field(self.path / "map.ply", field)

    def read_map(self) -> GaussianField:
        """Read map.ply. Raises RunError if it is missing, SourceError if it is damaged."""
        return ply.read_field(self._existing("map.ply"))

    def write_checkpoint(self, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
        """Write checkpoint.safetensors: named tensors and text."""
        # safetensors refuses views that share memory, so each tensor gets its own.
        own = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}
        with replacing(self.path / "checkpoint.safetensors") as temporary:
            save_file(own, temporary, metadata)
            temporary.chmod(0o666 & ~_umask())  # safetensors makes it private

    def read_checkpoint(self) -> tuple[dict[str, Tensor], dict[str, str]]:
        """Read checkpoint.safetensors: tensors and text. Raises RunError if it is missing or damaged."""
        path = self._existing("checkpoint.safetensors")
        try:
            with safe_open(path, "pt") as file:
                return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}  # noqa: SIM118
        except SafetensorError as problem:
            raise RunError(f"checkpoint {path} is damaged: {problem}") from problem

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """Write metrics.json; nan and inf become null."""
        self._write_json("metrics.json", metrics)

    def write_profile(self, seconds: dict[str, float]) -> None:
        """Write profile.json: seconds by stage."""
        self._write_json("profile.json", seconds)

    def read_profile(self) -> dict[str, float]:
        """Read profile.json. Raises RunError if it is missing or damaged."""
        return self._read_json("profile.json")

    def read_metrics(self) -> dict[str, Any]:
        """Read metrics.json. Raises RunError if it is missing or damaged."""
        return self._read_json("metrics.json")

    def write_report(self, html: str) -> None:
        """Write report.html."""
        write_text(self.path / "report.html", html)

    def write_image(self, name: str, picture: Image.Image) -> None:
        """Write images/<name>, a PNG."""
        with replacing(self.images / name) as temporary:
            picture.save(temporary, "PNG")

    def _existing(self, name: str) -> Path:
        if not (self.path / name).is_file():
            raise RunError(f"run {self.path} has no {name}; did it stop before writing it? run it again")
        return self.path / name

    def _text(self, name: str) -> str:
        try:
            return self._existing(name).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as problem:
            raise RunError(f"cannot read {self.path / name}: {problem}") from problem

    def _write_json(self, name: str, values: dict[str, Any]) -> None:
        write_text(self.path / name, json.dumps(plain(values), indent=2, allow_nan=False) + "\n")

    def _read_json(self, name: str) -> dict[str, Any]:
        try:
            values = json.loads(self._text(name))
        except json.JSONDecodeError as problem:
            raise RunError(f"{self.path / name} is not JSON: {problem}") from problem
        if not isinstance(values, dict):
            raise RunError(f"{self.path / name} does not hold named values")
        return values


def plain(value: Any) -> Any:
    """Turn a value into what JSON can hold: arrays and tensors to lists, nan and inf to None, paths to text."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | Tensor):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
