"""Write what belongs to a map: how sure it is (uncertainty.json, uncertainty.safetensors), and the components that are
not connected to the world (components/N/trajectory.txt and map.ply).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from sigmasplat.data.trajectory import Component
from sigmasplat.errors import RunError
from sigmasplat.files.atomic import make_folder
from sigmasplat.files.json_files import read_json, write_json
from sigmasplat.files.tensors import open_tensors, write_tensors
from sigmasplat.run_folder import splat_ply as ply
from sigmasplat.run_folder.trajectory import write_trajectory
from sigmasplat.uncertainty.map_uncertainty import (
    COLOR_PARTS,
    DEPTH_PARTS,
    SPLAT_COLUMNS,
    VARIANCES,
    Background,
    Calibration,
    MapUncertainty,
    SplatStd,
)

UNCERTAINTY_JSON, UNCERTAINTY_TENSORS = "uncertainty.json", "uncertainty.safetensors"
STD_TENSORS = ("depth_std_m", "color_std")


def write_uncertainty(folder: Path, uncertainty: MapUncertainty) -> None:
    """Write both files. Raises RunError if they cannot be written."""
    tensors, std = {"variances": uncertainty.splats.cpu()}, uncertainty.std
    if std is not None:
        tensors |= {name: values.cpu() for name, values in vars(std).items()}
    write_tensors(
        folder / UNCERTAINTY_TENSORS, tensors, {"columns": ",".join(SPLAT_COLUMNS[: uncertainty.splats.shape[1]])}
    )
    calibration, background = uncertainty.calibration, asdict(uncertainty.background)
    values = {"probes": uncertainty.probes, "background": background}
    values |= {name: dict(of) for name, of in vars(calibration).items()}
    write_json(folder / UNCERTAINTY_JSON, values)


def read_uncertainty(folder: Path) -> MapUncertainty | None:
    """Read both files; None if there is no uncertainty.json. Raises RunError if one is damaged."""
    path = folder / UNCERTAINTY_JSON
    if not path.is_file():
        return None
    values = read_json(path)
    try:
        behind = values["background"]
        red, green, blue = map(float, behind["color"])
        known = Background((red, green, blue), float(behind["color_variance"]), float(behind["depth_variance_m2"]))
        color = {name: float(values["color"][name]) for name in COLOR_PARTS}
        depth = {name: float(values["depth"][name]) for name in DEPTH_PARTS}
        temperature = {name: float(T) for name, T in values.get("temperature", {}).items()}
        probes = int(values["probes"])
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise RunError(f"{path} is not the uncertainty of a map: {problem!r}; run it again") from problem
    with open_tensors(folder / UNCERTAINTY_TENSORS, "uncertainty") as file:
        found = {name: file.get_tensor(name) for name in STD_TENSORS if name in file.keys()}  # noqa: SIM118
        std = SplatStd(**found) if len(found) == len(STD_TENSORS) else None
        return MapUncertainty(file.get_tensor("variances"), known, Calibration(color, depth, temperature), probes, std)


def refuse_misfit(folder: Path, uncertainty: MapUncertainty, splats: int) -> None:
    """Raise RunError unless the uncertainty of a run has one row for each splat of its map."""
    std, (rows, columns) = uncertainty.std, uncertainty.splats.shape
    fits = std is None or std.depth_std_m.shape == std.color_std.shape == (splats,)
    if rows != splats or columns not in (VARIANCES, len(SPLAT_COLUMNS)) or not fits:
        path = folder / UNCERTAINTY_TENSORS
        raise RunError(f"{path} has {rows} rows for {splats} splats; delete {UNCERTAINTY_JSON}, or run it again")


COMPONENT_FILES = ("trajectory.txt", "map.ply")
"""The files of a component."""


def write_components(folder: Path, components: Sequence[Component]) -> None:
    """Write the path and map of each component N into folder/N, in the component's own frame.

    Files of components that are not given are removed. Raises RunError if a file cannot be written.
    """
    for component in components:
        own = folder / str(component.number)
        make_folder(own)
        write_trajectory(own / "trajectory.txt", component.trajectory)
        ply.write_field(own / "map.ply", component.field)
    for number in set(component_numbers(folder)) - {component.number for component in components}:
        for name in COMPONENT_FILES:
            (folder / str(number) / name).unlink(missing_ok=True)
        _remove_if_empty(folder / str(number))
    _remove_if_empty(folder)


def component_numbers(folder: Path) -> list[int]:
    """Return the numbers of the components in a folder, in ascending order."""
    return sorted(int(entry.name) for entry in folder.glob("*") if entry.name.isdecimal())


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()
