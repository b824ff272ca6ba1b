"""Make messages of a map: its splats as points, its floor plan as grids."""

import numpy as np
from torch import Tensor

from sigmasplat.data.field import GaussianField
from sigmasplat.plugins.outputs.floorplan.floor_plan import FREE, OBJECT, WALL, FloorPlan
from sigmasplat.plugins.robots.ros_messages import GRID, GRID_STD, Encoded, Points, RosMessages

MAX_POINTS = 200_000
MIN_OPACITY = 0.5
UNKNOWN, EMPTY, OCCUPIED = -1, 0, 100
"""Values of nav_msgs/OccupancyGrid."""
CM_PER_M = 100.0


def points_of(field: GaussianField, depth_std_m: Tensor | None, most: int = MAX_POINTS) -> Points:
    """Return the centres of the opaque splats as a copy, evenly thinned to `most`.

    depth_std_m [N]: standard deviation of the depth that each splat shows; None if it was not measured.
    """
    opacities = field.opacities.detach().cpu().numpy()
    rows = np.flatnonzero(opacities >= MIN_OPACITY)
    rows = rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]
    std = np.full(len(rows), np.nan, np.float32) if depth_std_m is None else depth_std_m.cpu().numpy()[rows]
    means, colors = (values.detach().cpu().numpy()[rows] for values in (field.means, field.colors))
    return Points(means.astype(np.float32), colors.astype(np.float32), opacities[rows], std.astype(np.float32))


def grids(plan: FloorPlan, stamp_ns: int, frame: str, messages: RosMessages) -> list[Encoded]:
    """Make two nav_msgs/OccupancyGrid of a floor plan: what is occupied, and how sure its surfaces are.

    The first: 0 free floor, 100 object or wall, −1 not observed, also where only the floor was not observed. The
    second: the standard deviation of depth of the surfaces in a cell in cm, at most 100; −1 without a surface.
    frame: the frame with the axes of `levelled_map`. The grids are not rotated in it, because navigation software
    ignores the rotation of a grid.
    """
    occupied = np.full(plan.kind.shape, UNKNOWN, np.int8)
    occupied[plan.kind == FREE] = EMPTY
    occupied[(plan.kind == OBJECT) | (plan.kind == WALL)] = OCCUPIED
    known = np.isfinite(plan.depth_sigma_m)
    std_cm = np.rint(CM_PER_M * np.minimum(np.where(known, plan.depth_sigma_m, 0.0), 1.0))
    T_frame_grid = np.eye(4)  # x ahead is y of the plan, y left is −x of the plan
    T_frame_grid[:2, 3] = plan.origin_m[1], -(plan.origin_m[0] + plan.cell_m * plan.kind.shape[1])
    layers = ((GRID, occupied), (GRID_STD, np.where(known, std_cm, UNKNOWN).astype(np.int8)))
    return [
        messages.grid(topic, stamp_ns, frame, np.ascontiguousarray(cells.T[::-1]), plan.cell_m, T_frame_grid)
        for topic, cells in layers
    ]
