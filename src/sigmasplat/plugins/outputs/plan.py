"""Make the floor plan of a run, and write it as an image, and its data as JSON."""

from functools import partial
from pathlib import Path

from sigmasplat.data.camera import Camera
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import RunError
from sigmasplat.files.atomic import replacing
from sigmasplat.files.json_files import write_json
from sigmasplat.plugins.outputs.floorplan.floor_plan import CELL_M, FloorPlan, floor_plan
from sigmasplat.plugins.outputs.floorplan.picture import draw_floor_plan
from sigmasplat.plugins.outputs.run_reader import RunReader
from sigmasplat.render import FieldRenderer
from sigmasplat.run_folder.frames import noted_up
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.types import Progress, no_progress
from sigmasplat.uncertainty.predictive import predict


def run_floor_plan(
    run: RunFolder, path: Trajectory, camera: Camera, *, cell_m: float = CELL_M, progress: Progress = no_progress
) -> FloorPlan:
    """Make the floor plan of a run's map.

    path: the believed poses; camera: that of the images the run worked on. It is rendered with the run's settings, and
    its errors are predicted if the run has measured how sure its map is. Calls `progress(poses done, total)`. Raises
    RunError without a map, or if the uncertainty belongs to another map; ConfigError unless 1 mm ≤ cell_m ≤ 1 m;
    SigmaSplatError if no surface is visible.
    """
    config, field = run.config(), run.read_map()
    renderer = FieldRenderer(config.render, config.backend)
    known = run.uncertainty_of(field)
    predictor = None
    if known is not None:
        predictor = partial(predict, field, known, options=config.render, backend=config.backend)
    return floor_plan(
        field, path, camera, cell_m=cell_m, renderer=renderer, predictor=predictor, up_world=noted_up(run.facts()),
        progress=progress,
    )  # fmt: skip


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
