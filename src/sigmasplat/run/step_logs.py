"""Write the values of every frame for other programs while a session runs: CSV, TensorBoard, rerun (`run --log`).

The files are in logs/ of the run folder. A resumed run continues them. TensorBoard and rerun are optional packages.
"""

import csv
import importlib
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmasplat.env import install_extra
from sigmasplat.errors import ConfigError, nearest
from sigmasplat.files.atomic import make_folder, write_text
from sigmasplat.run.callbacks import Callback
from sigmasplat.run_folder.runs import RunFolder

if TYPE_CHECKING:
    from sigmasplat.slam.results import Step

EXTRA = "logs"
CSV, TENSORBOARD, RERUN = "steps.csv", "tensorboard", "steps{}.rrd"
TRACKING = ("agreement", "overlap", "loss", "iterations")
SECONDS = ("track", "map", "total")
COLUMNS = (
    "index", "timestamp_s", "state", "component", "is_keyframe", "submap", "p_off", "splats", "loops_closed",
    "x_m", "y_m", "z_m", *(f"tracking.{name}" for name in TRACKING), *(f"seconds.{name}" for name in SECONDS),
)  # fmt: skip
"""Columns of steps.csv, as in log.jsonl; position of the camera as estimated when the frame was processed."""


def values_of(step: "Step") -> dict[str, Any]:
    """Return the values of a step by column; a value that the step does not have is None."""
    x, y, z = (float(value) for value in step.T_world_camera[:3, 3])
    return {
        "index": step.index, "timestamp_s": step.timestamp_s, "state": step.state, "component": step.component,
        "is_keyframe": int(step.is_keyframe), "submap": step.submap, "p_off": step.p_off, "splats": step.splats,
        "loops_closed": sum(loop.accepted for loop in step.loops), "x_m": x, "y_m": y, "z_m": z,
        **{f"tracking.{name}": step.tracking.get(name) for name in TRACKING},
        **{f"seconds.{name}": step.seconds.get(name) for name in SECONDS},
    }  # fmt: skip


class StepLog(Callback):
    """A log of steps. It creates its files at the first step, so that a run that fails before it leaves nothing."""

    def close(self) -> None:
        """Complete the files."""


class CsvLog(StepLog):
    """Writes logs/steps.csv, a line per frame. Lines of a stopped run from frame `first_index` on are replaced."""

    def __init__(self, folder: Path, first_index: int) -> None:
        self.path, self.first_index = folder / CSV, first_index

    def __call__(self, step: "Step") -> None:
        """Append a line. Raises RunError if the file cannot be written."""
        if self.first_index >= 0:
            self._begin()
        with self.path.open("a", encoding="utf-8", newline="") as file:
            csv.writer(file).writerow(values_of(step).values())

    def _begin(self) -> None:
        make_folder(self.path.parent)
        text = io.StringIO(newline="")
        lines = csv.writer(text)
        lines.writerow(COLUMNS)
        if self.first_index and self.path.is_file():
            with self.path.open(encoding="utf-8", newline="") as file:
                earlier = list(csv.reader(file))[1:]
            lines.writerows(row for row in earlier if len(row) == len(COLUMNS) and int(row[0]) < self.first_index)
        write_text(self.path, text.getvalue())
        self.first_index = -1


class TensorBoardLog(StepLog):
    """Writes logs/tensorboard. Values of a stopped run from frame `first_index` on are hidden."""

    def __init__(self, folder: Path, first_index: int) -> None:
        self.writer_type = _imported("torch.utils.tensorboard", "tensorboard").SummaryWriter
        self.folder, self.first_index = folder / TENSORBOARD, first_index
        self.writer: Any = None

    def __call__(self, step: "Step") -> None:
        """Write the numbers of a step."""
        if self.writer is None:
            self.writer = self.writer_type(str(self.folder), purge_step=self.first_index or None)
        for name, value in values_of(step).items():
            if isinstance(value, int | float) and name not in ("index", "timestamp_s"):
                self.writer.add_scalar(name.replace(".", "/"), value, step.index)

    def close(self) -> None:
        """Write what is still in memory."""
        if self.writer is not None:
            self.writer.close()


class RerunLog(StepLog):
    """Writes logs/steps.rrd: camera, path and values. A resumed run writes steps-N.rrd, from frame N on."""

    def __init__(self, folder: Path, first_index: int) -> None:
        self.rerun = _imported("rerun", "rerun")
        self.path = folder / RERUN.format(f"-{first_index}" if first_index else "")
        self.stream: Any = None
        self.positions = list[tuple[float, float, float]]()

    def __call__(self, step: "Step") -> None:
        """Write the pose and the numbers of a step; the path so far at keyframes."""
        rerun, values = self.rerun, values_of(step)
        if self.stream is None:
            make_folder(self.path.parent)
            self.stream = rerun.RecordingStream("sigmasplat")
            self.stream.save(str(self.path))
            self.stream.log("world", rerun.ViewCoordinates.RDF, static=True)
        self.stream.set_time("frame", sequence=step.index)
        self.stream.set_time("time", duration=step.timestamp_s)
        T = step.T_world_camera
        self.stream.log("world/camera", rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self.positions.append((values["x_m"], values["y_m"], values["z_m"]))
        if step.is_keyframe:
            self.stream.log("world/path", rerun.LineStrips3D([self.positions]))
        for name, value in values.items():
            if isinstance(value, int | float) and name not in ("index", "timestamp_s"):
                self.stream.log(f"values/{name.replace('.', '/')}", rerun.Scalars(float(value)))

    def close(self) -> None:
        """Write what is still in memory."""
        if self.stream is not None:
            self.stream.flush()
            self.stream.disconnect()


LOGS: dict[str, Callable[[Path, int], StepLog]] = {"csv": CsvLog, "tensorboard": TensorBoardLog, "rerun": RerunLog}


def log_names(text: str) -> tuple[str, ...]:
    """Split names such as csv,rerun and check that their packages are installed. Raises ConfigError."""
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    for name in names:
        if name not in LOGS:
            raise ConfigError(f"no log {name!r}{nearest(name, LOGS)}; --log takes {', '.join(LOGS)}")
        LOGS[name](Path(), 0)
    return names


@contextmanager
def step_logs(names: Sequence[str], run: RunFolder, first_index: int = 0) -> Iterator[list[Callback]]:
    """Yield the logs with these names, as callbacks of a session that begins at a source frame; then complete them."""
    with ExitStack() as stack:
        logs = [LOGS[name](run.logs, first_index) for name in names]
        for log in logs:
            stack.callback(log.close)
        yield list(logs)


def _imported(module: str, name: str) -> Any:
    """Import an optional package. Raises ConfigError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as problem:
        raise ConfigError(f"--log {name} needs a package: {install_extra(EXTRA)}") from problem
