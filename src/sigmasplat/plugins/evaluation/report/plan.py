"""Make the floor plan of a run: the report and the exported plan use this one function, so that both agree."""

from functools import partial

from sigmasplat.data.camera import Camera
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.plugins.outputs.floorplan.floor_plan import CELL_M, FloorPlan, floor_plan
from sigmasplat.render import FieldRenderer
from sigmasplat.render.predictive import predict
from sigmasplat.run_folder.frames import noted_up
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.types import Progress, no_progress


def run_floor_plan(
    run: RunFolder, path: Trajectory, camera: Camera, *, cell_m: float = CELL_M, progress: Progress = no_progress
) -> FloorPlan:
    """Make the floor plan of a run's map.

    path: the valid poses; camera: that of the images the run worked on. It is rendered with the run's settings, and
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
