"""Describe the options of the command line: type, placeholder, one line of help each; and turn them into values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sigmasplat import env
from sigmasplat.config import Config
from sigmasplat.config.text import override, split_settings
from sigmasplat.errors import ConfigError, RunError
from sigmasplat.presets import families, preset as preset_of
from sigmasplat.viewer.server import HOST, PORT

if TYPE_CHECKING:
    from sigmasplat.io.runs import RunFolder
    from sigmasplat.sources.base import Source

arg = tyro.conf.arg


def _number(read: Callable[[str], float]) -> tyro.constructors.PrimitiveConstructorSpec[float | None]:
    """Describe a number that may be left out, None then: what is given is read as a number, and never as None."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NUMBER",
        instance_from_str=lambda given: read(given[0]),
        is_instance=lambda value: value is None or isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )


Whole = Annotated[int | None, _number(int)]
Number = Annotated[float | None, _number(float)]
PresetName = Annotated[str, arg(metavar="NAME", help=f"settings to start from: {', '.join(families())}")]
Shell = Annotated[Literal["bash", "zsh"], tyro.conf.Positional, arg(metavar="{bash,zsh}", help="the shell you type in")]
Settings = Annotated[
    tuple[str, ...],
    tyro.conf.UseAppendAction,
    arg(name="set", metavar="SECTION.NAME=VALUE", help="change one setting"),
]
Seed = Annotated[Whole, arg(metavar="N", help="start of all random numbers", help_behavior_hint="(default: 0)")]
RunPath = Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="run folder")]
OutFolder = Annotated[
    Path | None,
    arg(metavar="DIR", aliases=["--output"], help="run folder", help_behavior_hint="(default: a new one in runs/)"),
]
DemoFolder = Annotated[Path, arg(metavar="DIR", aliases=["--output"], help="run folder")]
Frames = Annotated[int, arg(metavar="N", help="length of the walk through the room")]
SourcePath = Annotated[
    str, tyro.conf.Positional, arg(metavar="PATH", help="a recording, synthetic[:frames=N], or realsense: the camera")
]
SourcePaths = Annotated[
    tuple[str, ...],
    tyro.conf.Positional,
    arg(
        metavar="SOURCE",
        help="folders of sequences, or synthetic[:frames=N,…]; {seed} in one becomes the seed's number",
        help_behavior_hint="(at least one)",
    ),
]
Seeds = Annotated[int, arg(metavar="N", help="runs of each variant, with seeds 0, 1, … N − 1")]
Tau = Annotated[float, arg(metavar="T", help="τ of every weight, one for all data")]
WithoutVariance = Annotated[
    bool, arg(help="run also without learning any variance, for reference", help_behavior_hint="")
]
AblationFile = Annotated[Path, arg(metavar="FILE", help="JSON file to write, and to go on with where it stopped")]
DropRuns = Annotated[
    bool, arg(name="overwrite", help="drop runs in FILE that were made otherwise", help_behavior_hint="")
]
Keep = Annotated[
    Path | None, arg(metavar="DIR", help="keep the run folders here", help_behavior_hint="(default: removed)")
]
Overwrite = Annotated[bool, arg(help="replace what is there", help_behavior_hint="")]
Limit = Annotated[Whole, arg(metavar="N", help="take at most N frames", help_behavior_hint="(default: all)")]
Profile = Annotated[bool, arg(help="print where the time went", help_behavior_hint="")]
SaveEvery = Annotated[
    float, arg(metavar="S", help="seconds between savings of the state that `resume` goes on from; 0 = at the end only")
]
View = Annotated[
    bool, arg(help="show the run in the browser while it goes on, and until Ctrl-C", help_behavior_hint="")
]
Host = Annotated[str, arg(metavar="ADDRESS", help="where the viewer listens; by default only this machine reaches it")]
Port = Annotated[int, arg(metavar="N", help="port of the viewer, or the next free one; 0 = any")]
Evaluate = Annotated[bool, arg(name="eval", help="make no metrics and no report", help_behavior_hint="")]
MovedSource = Annotated[
    str | None,
    arg(
        name="source",
        metavar="PATH",
        help="the sequence, if it has moved",
        help_behavior_hint="(default: where it was)",
    ),
]
OutFile = Annotated[
    Path | None, arg(metavar="FILE", help="file to write", help_behavior_hint="(default: RUN's name, here)")
]
Record = Annotated[
    Path | None,
    arg(
        metavar="DIR",
        help="where to record what a live camera sees",
        help_behavior_hint="(default: recording/ in the run folder)",
    ),
]
MeshFile = Annotated[
    Path | None,
    arg(metavar="FILE", help="file to write: .ply, .obj or .glb", help_behavior_hint="(default: mesh.ply in RUN)"),
]
VoxelM = Annotated[float, arg(metavar="M", help="edge of a voxel in metres; distances are truncated at four of them")]
WithMesh = Annotated[
    bool,
    arg(name="mesh", help="make mesh.ply too, and score it where the true surface is known", help_behavior_hint=""),
]
RunOrMap = Annotated[Path, tyro.conf.Positional, arg(metavar="RUN", help="run folder, or a file that holds a map")]
Format = Annotated[
    str | None,
    arg(metavar="NAME", help="what to write", help_behavior_hint="(default: by the ending of FILE, else ply)"),
]
SigmaBelow = Annotated[
    Number,
    arg(
        metavar="S", help="keep splats whose σ is below this, colours being 0 to 1", help_behavior_hint="(default: all)"
    ),
]
OpacityAbove = Annotated[
    Number,
    arg(metavar="A", help="keep splats whose opacity is above this", help_behavior_hint="(default: all)"),
]
Plain = Annotated[
    bool, arg(help="PLY in 3DGS's own 62 columns, without σ², for readers that know no others", help_behavior_hint="")
]
Pictures = Annotated[
    bool, arg(help="write the keyframes' pictures too, and take only these as views", help_behavior_hint="")
]
CellM = Annotated[float, arg(metavar="M", help="edge of the floor plan's cells in metres")]
FilmSize = Annotated[
    int, arg(metavar="PX", help="width of each of a film's panels", help_behavior_hint="(default: the run's images')")
]
FilmRate = Annotated[float, arg(metavar="N", help="images per second of a film")]
FilmSeconds = Annotated[
    Number,
    arg(metavar="S", help="length of a film", help_behavior_hint="(default: the path's, 4 to 60; orbit 12)"),
]
FilmPath = Annotated[Literal["run", "orbit"], arg(help="a film goes along the run's path, or round the room above it")]


@dataclass(frozen=True)
class InputOptions:
    """What is taken of a sequence: shorthands of the settings input.*, which --set reaches too."""

    limit: Limit = None
    stride: Annotated[Whole, arg(metavar="N", help="take every N-th frame", help_behavior_hint="")] = None
    start: Annotated[Number, arg(metavar="S", help="begin S seconds in", help_behavior_hint="")] = None
    end: Annotated[Number, arg(metavar="S", help="stop S seconds in", help_behavior_hint="")] = None
    strict: Annotated[bool, arg(help="stop at an unreadable image, do not pass it over", help_behavior_hint="")] = False
    calibration: Annotated[
        Path | None, arg(metavar="FILE", help="calibration.json in place of the recorded one", help_behavior_hint="")
    ] = None
    fx: Annotated[Number, arg(metavar="PX", help="focal length; fy too, if not given", help_behavior_hint="")] = None
    fy: Annotated[Number, arg(metavar="PX", help="focal length, vertical", help_behavior_hint="")] = None
    cx: Annotated[Number, arg(metavar="PX", help="principal point", help_behavior_hint="")] = None
    cy: Annotated[Number, arg(metavar="PX", help="principal point", help_behavior_hint="")] = None
    depth_scale: Annotated[Number, arg(metavar="UNITS", help="PNG units of depth per metre", help_behavior_hint="")] = (
        None
    )
    color_topic: Annotated[str | None, arg(metavar="NAME", help="topic of a ROS bag", help_behavior_hint="")] = None
    depth_topic: Annotated[str | None, arg(metavar="NAME", help="topic of a ROS bag", help_behavior_hint="")] = None
    register_depth: Annotated[
        Literal["auto", "on", "off"],
        arg(help="move depth into the colour camera; auto: where the recording says that it has one of its own"),
    ] = "auto"

    def settings(self) -> dict[str, str]:
        """Return what was given, by the settings' names. Raises ConfigError on numbers that mean nothing."""
        for name in ("limit", "stride"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ConfigError(f"--{name} must be at least 1, found {value}")
        names = {"start": "start_s", "end": "end_s"}
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        given["register_depth"] = None if self.register_depth == "auto" else self.register_depth
        given["calibration"] = self.calibration and self.calibration.resolve()  # a later eval may start elsewhere
        return {
            f"input.{names.get(name, name)}": str(value) for name, value in given.items() if value not in (None, False)
        }


DEFAULT_INPUT_OPTIONS = InputOptions()
InputOptionsFlat = Annotated[InputOptions, arg(name=""), tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True)
class RunOptions:
    """How a run is carried through: scored or not, kept how often, shown where."""

    evaluate: Evaluate = True
    profile: Profile = False
    save_every: SaveEvery = 60.0
    view: View = False
    host: Host = HOST
    port: Port = PORT


DEFAULT_RUN_OPTIONS = RunOptions()
RunOptionsFlat = Annotated[RunOptions, arg(name=""), tyro.conf.OmitArgPrefixes]


def configured(
    preset: str, settings: Sequence[str], seed: int | None, taken: InputOptions = DEFAULT_INPUT_OPTIONS
) -> Config:
    """Return a preset's settings with those of --set, the shorthands and --seed in place. Raises ConfigError."""
    given = split_settings(settings) | taken.settings()
    config = override(preset_of(preset), given)
    return config if seed is None else override(config, {"seed": str(seed)})


def source_of(folder: "RunFolder", moved_to: str | None) -> "Source":
    """Open the sequence that a run was made of. Raises RunError if the run does not say where it was."""
    from sigmasplat.sources import open_source

    facts = folder.facts()
    path = moved_to or facts.get("source_path")
    if not path:
        raise RunError(f"run {folder.path} does not say where its sequence was; give --source PATH")
    return open_source(path, folder.config().input)


def refuse_existing(target: Path | None, overwrite: bool) -> None:
    """Raise RunError if there is something at `target` that may not be overwritten."""
    if target and target.exists() and not overwrite:
        raise RunError(f"{target} exists; give another --out, or --overwrite to replace it")


def prepare_torch() -> None:
    """Give torch as many threads as the environment gives the kernels."""
    import torch

    if env.switches().threads:
        torch.set_num_threads(env.switches().threads)
