"""Define numbers as options, and the options that select and calibrate the input of all commands that open one."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from sigmasplat.config import RECORDED_POSES
from sigmasplat.config.ranges import Range


def arg(metavar: str | None, help: str, hint: str | None = None, **more: Any) -> Any:
    """Describe an option: its placeholder, one line of help, and what the help says of the default (None: its value).

    more: as for `tyro.conf.arg`.
    """
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=hint, **more)


def flag(help: str, **more: Any) -> Any:
    """Describe a switch that is off by default."""
    return arg(None, help, "", **more)


def _number(read: Callable[[str], float]) -> tyro.constructors.PrimitiveConstructorSpec[float | None]:
    """Describe an optional number: None if it is not given; a given text is always read as a number, never as None."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1, metavar="NUMBER", instance_from_str=lambda given: read(given[0]),
        is_instance=lambda value: value is None or isinstance(value, int | float),
        str_from_instance=lambda value: [str(value)],
    )  # fmt: skip


Whole = Annotated[int | None, _number(int)]
Number = Annotated[float | None, _number(float)]
From0 = Annotated[Number, Range(0)]
From1 = Annotated[int, Range(1)]
Limit = Annotated[Whole, Range(1), arg("N", "use at most N frames", "(default: all)")]


@dataclass(frozen=True)
class InputOptions:
    """Options that select and calibrate the input: short forms of the settings input.* of --set."""

    limit: Limit = None
    stride: Annotated[Whole, Range(1), arg("N", "use every N-th frame", "")] = None
    start: Annotated[From0, arg("S", "start S seconds after the first frame", "")] = None
    end: Annotated[From0, arg("S", "stop S seconds after the first frame", "")] = None
    hold_out: Annotated[
        Whole, Range(2, or_zero=True),
        arg("N", "hold back every N-th frame: it is tracked but not mapped, so that it can test the map", ""),
    ] = None  # fmt: skip
    strict: Annotated[bool, flag("stop at an unreadable image instead of skipping it")] = False
    calibration: Annotated[
        Path | None, arg("FILE", "calibration.json to use instead of the recorded calibration", "")
    ] = None
    masks: Annotated[Path | None, arg(
        "FOLDER", "ignore pixels: one image per frame of the recording, not 0 = ignored, such as people found by a "
        "segmenter", "",
    )] = None  # fmt: skip
    poses: Annotated[str | None, arg(
        "FILE", "known camera poses, used instead of tracking: TUM or KITTI text, images.txt of COLMAP, "
        'transforms.json, or a folder of matrices; "recorded" = those of the device, such as ARKit\'s', "",
    )] = None  # fmt: skip
    predicted_depth: Annotated[Path | None, arg(
        "FOLDER", "depth that a network predicted, one image per frame: for a video, for colour images, or instead of "
        "the recorded depth. The scale of the result is arbitrary", "",
    )] = None  # fmt: skip
    predicted_inverse: Annotated[bool, flag("predicted depth is inverse depth, as that of MiDaS or Depth Anything")] = (
        False
    )
    fx: Annotated[
        From0, arg("PX", "horizontal focal length in pixels; also the vertical one unless --fy is given", "")
    ] = None
    fy: Annotated[From0, arg("PX", "vertical focal length in pixels", "")] = None
    cx: Annotated[From0, arg("PX", "column of the principal point in pixels", "")] = None
    cy: Annotated[From0, arg("PX", "row of the principal point in pixels", "")] = None
    depth_scale: Annotated[From0, arg("UNITS", "units of the depth images per metre", "")] = None
    color_topic: Annotated[str | None, arg("NAME", "ROS bag: topic of the colour images", "")] = None
    depth_topic: Annotated[str | None, arg("NAME", "ROS bag: topic of the depth images", "")] = None
    register_depth: Annotated[
        Literal["auto", "on", "off"],
        arg(None, "register depth to the colour camera; auto: if the recording has a separate depth camera"),
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
InputOptionsFlat = Annotated[InputOptions, tyro.conf.arg(name=""), tyro.conf.OmitArgPrefixes]
