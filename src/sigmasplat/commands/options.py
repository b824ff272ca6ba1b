"""Define the options of the command line (type, placeholder, one line of help) and convert them to values."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat import env
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, From0, From1, InputOptions, Whole, arg, flag
from sigmasplat.config import Config, InputConfig
from sigmasplat.config.find_preset import FAMILIES, preset as preset_of
from sigmasplat.config.ranges import Range
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import RunError
from sigmasplat.plugins.viewer.server import HOST, PORT

if TYPE_CHECKING:
    from sigmasplat.input.source import Source
    from sigmasplat.run_folder.runs import RunFolder


PresetName = Annotated[str, arg("NAME", f"preset of settings to start from: {', '.join(FAMILIES)}")]
Settings = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction,
    arg("SECTION.NAME=VALUE", "change one setting; docs/settings.md lists them", name="set"),
]  # fmt: skip
Seed = Annotated[Whole, arg("N", "seed of all random numbers", "(default: 0)")]
RunPath = Annotated[Path, tyro.conf.Positional, arg("RUN", "run folder")]
OutFolder = Annotated[Path | None, arg("DIR", "run folder", "(default: a new one in runs/)", aliases=["--output"])]
DemoFolder = Annotated[Path, arg("DIR", "run folder", aliases=["--output"])]
Frames = Annotated[From1, arg("N", "number of frames")]
SourcePath = Annotated[
    str, tyro.conf.Positional,
    arg("PATH", "a recording, synthetic[:frames=N] for the synthetic room, or realsense for the camera"),
]  # fmt: skip
Runs = Annotated[From1, arg("N", "number of runs of each sequence, with seeds 0 to N − 1")]
Overwrite = Annotated[bool, flag("replace an earlier result")]
SaveEvery = Annotated[float, Range(0), arg("S", "save the state for `resume` every S seconds; 0 = at the end only")]
RealTime = Annotated[bool, flag("replay a recording at its own times, and track it in real time")]
View = Annotated[bool, flag("show the run in the browser while it runs, and afterwards until Ctrl-C")]
Host = Annotated[str, arg("ADDRESS", "address that the viewer listens on; the default allows this machine only")]
Port = Annotated[
    int, Range(0, 65535), arg("N", "port of the viewer; if it is busy, the next free one is used; 0 = any")
]
MovedSource = Annotated[
    str | None, arg("PATH", "path of the sequence if it has moved", "(default: its path in the run)", name="source")
]
OutFile = Annotated[Path | None, arg("FILE", "file to write", "(default: named after RUN, in this folder)")]
Record = Annotated[
    Path | None, arg("DIR", "folder for the recording of a live camera", "(default: recording/ in the run folder)")
]
UpEdge = Annotated[
    Literal["auto", "top", "left", "right", "bottom"],
    arg(None, "edge of the images that was up; auto: as an accelerometer measured, else top; the floor refines it"),
]  # fmt: skip
VoxelM = Annotated[float | None, Range(0, open_below=True), arg(
    "M", "edge of a voxel in metres; the truncation distance is 4 voxels",
    "(default: a pixel at the median depth, at most 0.01, times the scale of the scene)",
)]  # fmt: skip
WithMesh = Annotated[bool, flag("also write mesh.ply, and score it if the true surface is known", name="mesh")]
InRun = Annotated[Path, arg("RUN", "folder of a finished run, in whose map to search", name="in")]
OntoRun = Annotated[Path | None, arg("RUN", "continue the map of a finished run in a new run folder", "")]
FinalSeconds = Annotated[From0, arg(
    "S", "time budget of the final map's refinement in seconds: short form of --set final.seconds=S",
    "(default: no limit)",
)]  # fmt: skip
PosesFile = Annotated[
    Path | None, arg("FILE", "file to write: .jsonl (all results) or .txt (poses as TUM text)", "(default: none)")
]
RunOrMap = Annotated[Path, tyro.conf.Positional, arg("RUN", "run folder, or a map as PLY")]
Bag = Annotated[
    Path | None, arg("DIR", "also write a ROS 2 bag (MCAP): transforms, odometry, images; needs no ROS", "")
]
BagImages = Annotated[Literal["none", "keyframes", "all"], arg(None, "which images the bag contains, uncompressed")]


@dataclass(frozen=True)
class RunOptions:
    """Options of run and resume: scoring, saving, viewer, bag."""

    evaluate: Annotated[bool, flag("do not score the run: no metrics, no report", name="eval")] = True
    save_every: SaveEvery = 60.0
    view: View = False
    host: Host = HOST
    port: Port = PORT
    bag: Bag = None
    bag_images: BagImages = "keyframes"


DEFAULT_RUN_OPTIONS = RunOptions()
RunOptionsFlat = Annotated[RunOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]


def configured(
    preset: str, settings: Sequence[str], seed: int | None, input_options: InputOptions = DEFAULT_INPUT_OPTIONS,
    like: Config | None = None,
) -> Config:  # fmt: skip
    """Return a preset's settings, changed by --set, the input options and --seed; with `like`, working images are made
    as in these settings unless --set says otherwise. Raises ConfigError."""
    given = (working_images(like) if like else {}) | split_settings(settings) | input_options.settings()
    config = override(preset_of(preset), given)
    return config if seed is None else override(config, {"seed": str(seed)})


def working_images(config: Config) -> dict[str, str]:
    """Return the default settings of the input, but with the size and depth range of the images of `config`."""
    kept = {name: getattr(config.input, name) for name in ("width", "crop_px", "min_depth_m", "max_depth_m")}
    return {f"input.{name}": str(value) for name, value in (asdict(InputConfig(denoise_depth=False)) | kept).items()}


def source_of(folder: "RunFolder", moved_to: str | None) -> "Source":
    """Open the sequence of a run. Raises RunError if the run does not contain its path."""
    from sigmasplat.plugins.sources import open_source

    path = moved_to or folder.facts().get("source_path")
    if not path:
        raise RunError(f"run {folder.path} does not contain the path of its sequence; give --source PATH")
    return open_source(path, folder.config().input)


def refuse_existing(target: Path | None, overwrite: bool) -> None:
    """Raise RunError if `target` exists and may not be overwritten."""
    if target and target.exists() and not overwrite:
        raise RunError(f"{target} exists; give another --out, or --overwrite to replace it")


def prepare_torch() -> None:
    """Limit torch to the threads that the environment gives the kernels."""
    import torch

    if env.switches().threads:
        torch.set_num_threads(env.switches().threads)
