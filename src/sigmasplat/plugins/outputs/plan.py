"""Write a run's floor plan as an image, and its data as JSON."""

from pathlib import Path

from sigmasplat.errors import RunError
from sigmasplat.files.atomic import replacing
from sigmasplat.files.json_files import write_json
from sigmasplat.plugins.evaluation.report.plan import run_floor_plan
from sigmasplat.plugins.outputs.floorplan.floor_plan import CELL_M, FloorPlan
from sigmasplat.plugins.outputs.floorplan.picture import draw_floor_plan
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.types import Progress, no_progress


def export_plan(
    reader: RunReader, target: Path, *, cell_m: float = CELL_M, progress: Progress = no_progress
) -> FloorPlan:
    """Write the image (.png) and the data of the plan beside it (.json); return the plan.

    Calls `progress(done, total)` for each rendered view. Raises RunError on another ending, without a map or path, or
    if a file cannot be written; ConfigError unless 1 mm ≤ cell_m ≤ 1 m.
    """
    if target.suffix.lower() != ".png":
        raise RunError(f"cannot write a floor plan as {target.name}; give a name that ends in .png")
    plan = run_floor_plan(reader.run, reader.valid_path(), reader.camera, cell_m=cell_m, progress=progress)
    write_plan(plan, target)
    return plan


def write_plan(plan: FloorPlan, target: Path) -> None:
    """Write the image to `target` (.png) and the data beside it (.json).

    Raises RunError if a file cannot be written.
    """
    picture = draw_floor_plan(plan)
    with replacing(target) as temporary:
        picture.save(temporary, "PNG")
    write_json(target.with_suffix(".json"), plan.record())
