"""Define the options of the command line (type, placeholder, one line of help) and convert them to values."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat import env
from sigmasplat.config import RECORDED_POSES, Config, InputConfig
from sigmasplat.config.ranges import Range
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import RunError
from sigmasplat.presets import families, preset as preset_of
from sigmasplat.viewer.server import HOST, PORT

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.sources.base import Source

arg = tyro.conf.arg


def _number(read: Callable[[str], float]) -> tyro.constructors.PrimitiveConstructorSpec[float | None]:
    """Describe an optional number: None if it is not given; a given text is always read as a number, never as None."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NUMBER",
        instance_from_str=lambda given: read(given[0]),
        is_instance=lambda value: value is None or isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )


Whole = Annotated[int | None, _number(int)]
Number = Annotated[float | None, _number(float)]
From0 = Annotated[Number, Range(0)]
From1 = Annotated[int, Range(1)]
PresetName = Annotated[str, arg(metavar="NAME", help=f"preset of settings to start from: {', '.join(families())}")]
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
SourcePaths = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    arg(
        metavar="SOURCE",
        help="sequences: folders or synthetic[:frames=N,…]; {seed} is replaced by the seed",
        help_behavior_hint="(at least one)",
    ),
]
Seeds = Annotated[From1, arg(metavar="N", help="number of runs of each variant, with seeds 0 to N − 1")]
Runs = Annotated[From1, arg(metavar="N", help="number of runs of each sequence, with seeds 0 to N − 1")]
HoldEvery = Annotated[int, Range(2), arg(metavar="N", help="hold back every N-th frame from the map")]
MostViews = Annotated[From1, arg(metavar="N", help="largest number of views that are scored, of each kind")]
StudyFolder = Annotated[Path, arg(metavar="DIR", help="folder of the results; finished runs in it are reused")]
Tau = Annotated[float, Range(0, open_below=True), arg(metavar="T", help="τ, the same for every weight and sequence")]
WithoutVariance = Annotated[
    bool, arg(help="also run without learning any variance, as a reference", help_behavior_hint="")
]
AblationFile = Annotated[Path, arg(metavar="FILE", help="JSON file of the results; an existing one is continued")]
DropRuns = Annotated[
    bool,
    arg(name="overwrite", help="drop runs in FILE that have other settings, code or machine", help_behavior_hint=""),
]
Keep = Annotated[
    Path | None,
    arg(metavar="DIR", help="keep the run folders in DIR", help_behavior_hint="(default: they are removed)"),
]
Overwrite = Annotated[bool, arg(help="replace an earlier result", help_behavior_hint="")]
Limit = Annotated[Whole, Range(1), arg(metavar="N", help="use at most N frames", help_behavior_hint="(default: all)")]
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
PredictedDepth = Annotated[
    Path | None,
    arg(
        metavar="FOLDER",
        help="depth that a network predicted, one image per frame: for a video, for colour images, or instead of the "
        "recorded depth. The scale of the result is arbitrary",
        help_behavior_hint="",
    ),
]
PredictedInverse = Annotated[
    bool, arg(help="predicted depth is inverse depth, as that of MiDaS or Depth Anything", help_behavior_hint="")
]
RunOrMap = Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="run folder or map file")]


@dataclass(frozen=True)
class InputOptions:
    """Options that select and calibrate the input: short forms of the settings input.* of --set."""

    limit: Limit = None
    stride: Annotated[Whole, Range(1), arg(metavar="N", help="use every N-th frame", help_behavior_hint="")] = None
    start: Annotated[From0, arg(metavar="S", help="start S seconds after the first frame", help_behavior_hint="")] = (
        None
    )
    end: Annotated[From0, arg(metavar="S", help="stop S seconds after the first frame", help_behavior_hint="")] = None
    hold_out: Annotated[
        Whole,
        Range(2, or_zero=True),
        arg(
            metavar="N",
            help="hold back every N-th frame: it is tracked but not mapped, so that it can test the map",
            help_behavior_hint="",
        ),
    ] = None
    strict: Annotated[bool, arg(help="stop at an unreadable image instead of skipping it", help_behavior_hint="")] = (
        False
    )
    calibration: Annotated[
        Path | None,
        arg(metavar="FILE", help="calibration.json to use instead of the recorded calibration", help_behavior_hint=""),
    ] = None
    masks: Annotated[
        Path | None,
        arg(
            metavar="FOLDER",
            help="ignore pixels: one image per frame of the recording, not 0 = ignored, such as people found by a "
            "segmenter",
            help_behavior_hint="",
        ),
    ] = None
    poses: Annotated[
        str | None,
        arg(
            metavar="FILE",
            help="known camera poses, used instead of tracking: TUM or KITTI text, images.txt of COLMAP, "
            'transforms.json, or a folder of matrices; "recorded" = those of the device, such as ARKit\'s',
            help_behavior_hint="",
        ),
    ] = None
    predicted_depth: PredictedDepth = None
    predicted_inverse: PredictedInverse = False
    fx: Annotated[
        From0,
        arg(
            metavar="PX",
            help="horizontal focal length in pixels; also the vertical one unless --fy is given",
            help_behavior_hint="",
        ),
    ] = None
    fy: Annotated[From0, arg(metavar="PX", help="vertical focal length in pixels", help_behavior_hint="")] = None
    cx: Annotated[From0, arg(metavar="PX", help="column of the principal point in pixels", help_behavior_hint="")] = (
        None
    )
    cy: Annotated[From0, arg(metavar="PX", help="row of the principal point in pixels", help_behavior_hint="")] = None
    depth_scale: Annotated[
        From0, arg(metavar="UNITS", help="units of the depth images per metre", help_behavior_hint="")
    ] = None
    color_topic: Annotated[
        str | None, arg(metavar="NAME", help="ROS bag: topic of the colour images", help_behavior_hint="")
    ] = None
    depth_topic: Annotated[
        str | None, arg(metavar="NAME", help="ROS bag: topic of the depth images", help_behavior_hint="")
    ] = None
    register_depth: Annotated[
        Literal["auto", "on", "off"],
        arg(help="register depth to the colour camera; auto: if the recording has a separate depth camera"),
    ] = "auto"

    def settings(self) -> dict[str, str]:
        """Return the given options by the names of their settings."""
        names = {"start": "start_s", "end": "end_s", "hold_out": "hold_every"}
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        given["register_depth"] = None if self.register_depth == "auto" else self.register_depth
        for name in ("calibration", "masks", "predicted_depth"):  # a later eval may run in another folder
            given[name] = given[name] and given[name].absolute()
        if self.poses not in (None, RECORDED_POSES):
            given["poses"] = Path(self.poses).absolute()
        return {
            f"input.{names.get(name, name)}": str(value) for name, value in given.items() if value not in (None, False)
        }


DEFAULT_INPUT_OPTIONS = InputOptions()
InputOptionsFlat = Annotated[InputOptions, arg(name=""), tyro.conf.OmitArgPrefixes]


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
    as in these settings unless --set says otherwise. Raises ConfigError, also if settings exclude each other."""
    given = (working_images(like) if like else {}) | split_settings(settings) | input_options.settings()
    config = override(preset_of(preset), given)
    return (config if seed is None else override(config, {"seed": str(seed)})).checked()


def working_images(config: Config) -> dict[str, str]:
    """Return the default settings of the input, but with the size and depth range of the images of `config`."""
    kept = {name: getattr(config.input, name) for name in ("width", "crop_px", "min_depth_m", "max_depth_m")}
    return {f"input.{name}": str(value) for name, value in (asdict(InputConfig()) | kept).items()}


def source_of(folder: "RunFolder", moved_to: str | None) -> "Source":
    """Open the sequence of a run. Raises RunError if the run does not contain its path."""
    from sigmasplat.sources import open_source

    facts = folder.facts()
    path = moved_to or facts.get("source_path")
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
