"""Write the pose and the values of every frame as a recording of Rerun while a session runs (`run --log rerun`).

The files are in logs/ of the run folder. rerun-sdk is an optional package.
"""

import importlib
from typing import TYPE_CHECKING, Any

from sigmasplat.env import install_extra
from sigmasplat.errors import ConfigError
from sigmasplat.files.atomic import make_folder
from sigmasplat.run.callbacks import Callback
from sigmasplat.run_folder.runs import RunFolder

if TYPE_CHECKING:
    from sigmasplat.slam.results import Step


def rerun() -> Any:
    """Import Rerun. Raises ConfigError with the command that installs it."""
    try:
        return importlib.import_module("rerun")
    except ImportError as problem:
        raise ConfigError(f"--log rerun needs a package: {install_extra('logs')}") from problem


class RerunLog(Callback):
    """Writes logs/steps.rrd: camera, path and values. A run that is resumed at frame N writes steps-N.rrd.

    The file is created at the first step, so that a run that fails before it leaves nothing.
    """

    def __init__(self, run: RunFolder, first_index: int) -> None:
        self.path = run.logs / f"steps{f'-{first_index}' if first_index else ''}.rrd"
        self.stream: Any = None
        self.positions: list[Any] = []

    def __call__(self, step: "Step") -> None:
        """Write the pose and the numbers of a step; the path so far at keyframes."""
        sdk, T = rerun(), step.T_world_camera
        if self.stream is None:
            make_folder(self.path.parent)
            self.stream = sdk.RecordingStream("sigmasplat")
            self.stream.save(str(self.path))
            self.stream.log("world", sdk.ViewCoordinates.RDF, static=True)
        self.stream.set_time("frame", sequence=step.index)
        self.stream.set_time("time", duration=step.timestamp_s)
        self.stream.log("world/camera", sdk.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self.positions.append(T[:3, 3])
        if step.is_keyframe:
            self.stream.log("world/path", sdk.LineStrips3D([self.positions]))
        values = {name: getattr(step, name) for name in ("is_keyframe", "lost", "submap", "p_off", "splats")}
        for group in ("tracking", "seconds"):
            values |= {f"{group}/{name}": value for name, value in getattr(step, group).items()}
        for name, value in values.items():
            self.stream.log(f"values/{name}", sdk.Scalars(float(value)))

    def close(self) -> None:
        """Write what is still in memory."""
        if self.stream is not None:
            self.stream.flush()
            self.stream.disconnect()
