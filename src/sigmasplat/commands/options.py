"""Define the options of the command line (type, placeholder, one line of help) and convert them to values."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat import env
from sigmasplat.commands.input_options import DEFAULT_INPUT_OPTIONS, From0, From1, InputOptions, Whole
from sigmasplat.config import Config, InputConfig
from sigmasplat.config.presets import FAMILIES, preset as preset_of
from sigmasplat.config.ranges import Range
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import RunError
from sigmasplat.plugins.viewer.server import HOST, PORT

if TYPE_CHECKING:
    from sigmasplat.input.source import Source
    from sigmasplat.run_folder.runs import RunFolder

arg = tyro.conf.arg

PresetName = Annotated[str, arg(metavar="NAME", help=f"preset of settings to start from: {', '.join(FAMILIES)}")]
Shell = Annotated[
    Literal["bash", "zsh"], tyro.conf.Positional, arg(metavar="{bash,zsh}", help="the shell that you use")
]
Settings = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    arg(name="set", metavar="SECTION.NAME=VALUE", help="change one setting; docs/settings.md lists them"),
]
Seed = Annotated[Whole, arg(metavar="N", help="seed of all random numbers", help_behavior_hint="(default: 0)")]
RunPath = Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="run folder")]
OutFolder = Annotated[
    Path | None,
    arg(metavar="DIR", aliases=["--output"], help="run folder", help_behavior_hint="(default: a new one in runs/)"),
]
DemoFolder = Annotated[Path, arg(metavar="DIR", aliases=["--output"], help="run folder")]
Frames = Annotated[From1, arg(metavar="N", help="number of frames")]
SourcePath = Annotated[
    str,
    tyro.conf.Positional,
    arg(metavar="PATH", help="a recording, synthetic[:frames=N] for the synthetic room, or realsense for the camera"),
]
Runs = Annotated[From1, arg(metavar="N", help="number of runs of each sequence, with seeds 0 to N − 1")]
Overwrite = Annotated[bool, arg(help="replace an earlier result", help_behavior_hint="")]
Profile = Annotated[bool, arg(help="print the time spent in each stage", help_behavior_hint="")]
SaveEvery = Annotated[
    float, Range(0), arg(metavar="S", help="save the state for `resume` every S seconds; 0 = at the end only")
]
RealTime = Annotated[bool, arg(help="replay a recording at its own times, and track it in real time")]
AllPoses = Annotated[
    bool,
    arg(help="also write trajectory_all.txt with the poses of all frames, including lost ones", help_behavior_hint=""),
]
Log = Annotated[
    str,
    arg(
        metavar="NAMES",
        help="also write the values of every frame to logs/ in RUN: csv, tensorboard, rerun, or several by commas",
        help_behavior_hint="",
    ),
]
View = Annotated[
    bool, arg(help="show the run in the browser while it runs, and afterwards until Ctrl-C", help_behavior_hint="")
]
Host = Annotated[
    str,
    arg(metavar="ADDRESS", help="address that viewer and stream listen on; the default allows this machine only"),
]
Port = Annotated[
    int, Range(0, 65535), arg(metavar="N", help="port of the viewer; if it is busy, the next free one is used; 0 = any")
]
Evaluate = Annotated[bool, arg(name="eval", help="do not score the run: no metrics, no report", help_behavior_hint="")]
MovedSource = Annotated[
    str | None,
    arg(
        name="source",
        metavar="PATH",
        help="path of the sequence if it has moved",
        help_behavior_hint="(default: its path in the run)",
    ),
]
OutFile = Annotated[
    Path | None,
    arg(metavar="FILE", help="file to write", help_behavior_hint="(default: named after RUN, in this folder)"),
]
Record = Annotated[
    Path | None,
    arg(
        metavar="DIR",
        help="folder for the recording of a live camera",
        help_behavior_hint="(default: recording/ in the run folder)",
    ),
]
VoxelM = Annotated[
    float | None,
    Range(0, open_below=True),
    arg(
        metavar="M",
        help="edge of a voxel in metres; the truncation distance is 4 voxels",
        help_behavior_hint="(default: 0.01, times the scale of the scene)",
    ),
]
WithMesh = Annotated[
    bool,
    arg(name="mesh", help="also write mesh.ply, and score it if the true surface is known", help_behavior_hint=""),
]
InRun = Annotated[Path, arg(name="in", metavar="RUN", help="folder of a finished run, in whose map to search")]
OntoRun = Annotated[
    Path | None,
    arg(metavar="RUN", help="continue the map of a finished run in a new run folder", help_behavior_hint=""),
]
FinalSeconds = Annotated[
    From0,
    arg(
        metavar="S",
        help="time budget of the final map's refinement in seconds: short form of --set final.seconds=S",
        help_behavior_hint="(default: no limit)",
    ),
]
PosesFile = Annotated[
    Path | None,
    arg(
        metavar="FILE",
        help="file to write: .jsonl (all results) or .txt (poses as TUM text)",
        help_behavior_hint="(default: none)",
    ),
]
RunOrMap = Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="run folder or map file")]


@dataclass(frozen=True)
class RunOptions:
    """Options of run and resume: scoring, profile, saving, all poses, logs, viewer."""

    evaluate: Evaluate = True
    profile: Profile = False
    save_every: SaveEvery = 60.0
    all_poses: AllPoses = False
    log: Log = ""
    view: View = False
    host: Host = HOST
    port: Port = PORT


DEFAULT_RUN_OPTIONS = RunOptions()
RunOptionsFlat = Annotated[RunOptions, arg(name=""), tyro.conf.OmitArgPrefixes]


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
    """Open the sequence of a run. Raises RunError if the run does not contain its path, or if depth is predicted by
    another network than in the run."""
    from sigmasplat.plugins.sources import open_source
    from sigmasplat.run.same_conditions import refuse_other_model

    facts = folder.facts()
    path = moved_to or facts.get("source_path")
    if not path:
        raise RunError(f"run {folder.path} does not contain the path of its sequence; give --source PATH")
    source = open_source(path, folder.config().input)
    refuse_other_model(folder, source)
    return source


def refuse_existing(target: Path | None, overwrite: bool) -> None:
    """Raise RunError if `target` exists and may not be overwritten."""
    if target and target.exists() and not overwrite:
        raise RunError(f"{target} exists; give another --out, or --overwrite to replace it")


def prepare_torch() -> None:
    """Limit torch to the threads that the environment gives the kernels."""
    import torch

    if env.switches().threads:
        torch.set_num_threads(env.switches().threads)
