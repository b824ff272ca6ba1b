"""Write the floor plan of a run: a picture, and a JSON file beside it."""

from pathlib import Path

from sigmasplat.errors import RunError
from sigmasplat.exports.recorded import Recorded
from sigmasplat.floorplan.floor_plan import CELL_M, FloorPlan
from sigmasplat.floorplan.picture import draw_floor_plan
from sigmasplat.floorplan.surface_samples import SurfaceRenderer
from sigmasplat.io.atomic import replacing
from sigmasplat.io.json_files import write_json
from sigmasplat.report.plan import run_floor_plan
from sigmasplat.types import Progress


def export_plan(
    recorded: Recorded,
    target: Path,
    *,
    cell_m: float = CELL_M,
    renderer: SurfaceRenderer | None = None,
    progress: Progress = lambda done, total: None,
) -> FloorPlan:
    """Write target (.png) and the record of the plan beside it (.json); return the plan.

    Calls `progress(poses done, total)`. Raises RunError if the name does not end in .png, without a map or path, or if
    nothing can be written; ConfigError unless 1 mm ≤ cell_m ≤ 1 m.
    """
    if target.suffix.lower() != ".png":
        raise RunError(f"cannot write a floor plan as {target.name}; give a name that ends in .png")
    plan = run_floor_plan(
        recorded.run, recorded.trusted_path(), recorded.camera, cell_m=cell_m, renderer=renderer, progress=progress
    )
    picture = draw_floor_plan(plan)
    with replacing(target) as temporary:
        picture.save(temporary, "PNG")
    write_json(target.with_suffix(".json"), plan.record())
    return plan
