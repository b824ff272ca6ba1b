"""Write a run's floor plan: a picture, and the same in numbers beside it."""

from pathlib import Path

from sigmasplat.errors import RunError
from sigmasplat.exports.recorded import Recorded
from sigmasplat.floorplan.floor_plan import CELL_M, FloorPlan, floor_plan
from sigmasplat.floorplan.picture import draw_floor_plan
from sigmasplat.floorplan.surface_samples import Renderer
from sigmasplat.io.atomic import replacing
from sigmasplat.io.json_files import write_json
from sigmasplat.render import FieldRenderer
from sigmasplat.types import Progress


def export_plan(
    recorded: Recorded,
    target: Path,
    *,
    cell_m: float = CELL_M,
    renderer: Renderer | None = None,
    progress: Progress = lambda done, total: None,
) -> FloorPlan:
    """Write target (.png) and the record of the plan beside it (.json); return the plan.

    `progress` is told (looks done, of how many). Raises RunError on another ending, without a map or path, or where
    nothing can be written; ConfigError unless 1 mm ≤ cell_m ≤ 1 m.
    """
    if target.suffix.lower() != ".png":
        raise RunError(f"cannot write a floor plan as {target.name}; give a name that ends in .png")
    config = recorded.config
    renderer = renderer or FieldRenderer(config.render, config.backend)
    field, path = recorded.run.read_map(), recorded.trusted_path()
    plan = floor_plan(field, path, recorded.camera, cell_m=cell_m, renderer=renderer, progress=progress)
    picture = draw_floor_plan(plan)
    with replacing(target) as temporary:
        picture.save(temporary, "PNG")
    write_json(target.with_suffix(".json"), plan.record())
    return plan
