"""Write how sure a map is, and read it back: uncertainty.json, and the values of splats in uncertainty.safetensors."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from sigmasplat.data.map_uncertainty import (
    COLOR_PARTS,
    DEPTH_PARTS,
    SPLAT_COLUMNS,
    VARIANCES,
    Background,
    Calibration,
    MapUncertainty,
    SplatStd,
)
from sigmasplat.errors import RunError
from sigmasplat.files.json_files import read_json, write_json
from sigmasplat.files.tensors import open_tensors, write_tensors

ADDED_PARTS = frozenset({"extrapolated"})
"""Parts that older files do not have."""
JSON, TENSORS = "uncertainty.json", "uncertainty.safetensors"
STD_TENSORS = ("depth_std_m", "color_std")


def write_uncertainty(folder: Path, uncertainty: MapUncertainty) -> None:
    """Write both files. Raises RunError if they cannot be written."""
    tensors, std = {"variances": uncertainty.splats.cpu()}, uncertainty.std
    if std is not None:
        tensors |= {name: values.cpu() for name, values in vars(std).items()}
    write_tensors(folder / TENSORS, tensors, {"columns": ",".join(SPLAT_COLUMNS[: uncertainty.splats.shape[1]])})
    calibration, background = uncertainty.calibration, asdict(uncertainty.background)
    values = {"probes": uncertainty.probes, "background": background}
    values |= {name: dict(of) for name, of in vars(calibration).items()}
    write_json(folder / JSON, values)


def read_uncertainty(folder: Path) -> MapUncertainty | None:
    """Read both files; None if there is no uncertainty.json. Raises RunError if one is damaged.

    Files of older versions have no standard deviations of the splats.
    """
    path = folder / JSON
    if not path.is_file():
        return None
    values = read_json(path)
    try:
        behind = values["background"]
        red, green, blue = map(float, behind["color"])
        known = Background((red, green, blue), float(behind["color_variance"]), float(behind["depth_variance_m2"]))
        color = {name: _weight(values["color"], name) for name in COLOR_PARTS}
        depth = {name: _weight(values["depth"], name) for name in DEPTH_PARTS}
        temperature = {name: float(T) for name, T in values.get("temperature", {}).items()}
        probes = int(values["probes"])
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise RunError(f"{path} is not the uncertainty of a map: {problem!r}; run it again") from problem
    with open_tensors(folder / TENSORS, "uncertainty") as file:
        found = {name: file.get_tensor(name) for name in STD_TENSORS if name in file.keys()}  # noqa: SIM118
        std = SplatStd(**found) if len(found) == len(STD_TENSORS) else None
        return MapUncertainty(file.get_tensor("variances"), known, Calibration(color, depth, temperature), probes, std)


def _weight(weights: Mapping[str, float], name: str) -> float:
    """Return the weight of a part; 0 for a part that runs of older versions do not have."""
    return float(weights.get(name, 0.0) if name in ADDED_PARTS else weights[name])


def refuse_misfit(folder: Path, uncertainty: MapUncertainty, splats: int) -> None:
    """Raise RunError unless the uncertainty of a run has one row for each splat of its map."""
    std, (rows, columns) = uncertainty.std, uncertainty.splats.shape
    fits = std is None or std.depth_std_m.shape == std.color_std.shape == (splats,)
    if rows != splats or columns not in (VARIANCES, len(SPLAT_COLUMNS)) or not fits:
        raise RunError(f"{folder} has uncertainties of {rows} rows for {splats} splats; run it again")
