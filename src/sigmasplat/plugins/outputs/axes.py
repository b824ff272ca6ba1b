"""Rotate exports so that they stand upright: the axes by name, and the vertical direction of a run's map.

A run's world is the camera of its first frame: x right, y down, z forward, tilted as the camera was held. An export in
other axes is rotated about the origin of that world. It is never scaled or shifted, so the unit stays the metre.
The axes, and who expects them: docs/exports.md, section Axes. `y-up`: right, up, back; `z-up`: right, ahead, up;
`y-down`: right, down, ahead; `camera`: right, down, ahead, not levelled.

All levelled axes have the same horizontal directions, those of the floor plan: `ahead` is the direction along the walls
that is nearest to the viewing direction of the first camera. Blender's import of glTF turns `y-up` into `z-up`, so a
GLB and a `z-up` PLY of one run coincide there.
"""

from typing import Literal, get_args

import numpy as np

from sigmasplat.api import FieldRenderer, Matrix, SigmaSplatError, Trajectory, noted_up
from sigmasplat.plugins.outputs.floorplan.ground import floor_frame, horizontal, sample_surfaces, unit
from sigmasplat.plugins.outputs.run_reader import RunReader

Axes = Literal["y-up", "z-up", "y-down", "camera"]
AXES: tuple[Axes, ...] = get_args(Axes)

R_FLOOR_CAMERA = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""The floor's axes (x right, y ahead, z up) from those of a camera that is held level."""
_FROM_FLOOR = {
    "y-up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "z-up": np.eye(3),
    "y-down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}


def transform_to(axes: Axes, R_floor_world: Matrix = R_FLOOR_CAMERA) -> Matrix:
    """Return T_axes_world [4, 4], the rotation from a run's world to the named axes.

    R_floor_world [3, 3]: rotation to the floor's axes (`levelled`). The default assumes that the first camera was held
    level; use it for a map without a path. For `camera` the result is the identity.
    """
    T = np.eye(4)
    if axes != "camera":
        T[:3, :3] = _FROM_FLOOR[axes] @ R_floor_world
    return T


def levelled(reader: RunReader) -> Matrix:
    """Return R_floor_world [3, 3] of a run: x right, y ahead along the walls, z up.

    The vertical direction comes from the floor and the walls of the map, rendered along the path, and is the same in
    every export and in the floor plan. They are looked for near the direction that an accelerometer measured, or else
    near the mean vertical direction of the cameras, which is used alone if no surface is visible.
    Raises RunError if the run has no map or no path.
    """
    field, path, config = reader.run.read_map(), reader.valid_path(), reader.config
    up_world = noted_up(reader.run.facts())
    samples = sample_surfaces(field, path, reader.camera, FieldRenderer(config.render, config.backend))
    try:
        return floor_frame(list(samples), up_world)[:3, :3]
    except SigmaSplatError:
        return level_cameras(path, up_world)


def level_cameras(path: Trajectory, up_world: Matrix | None = None) -> Matrix:
    """Return R_floor_world [3, 3] without a map: z is the measured up direction `up_world` [3], or else the mean
    vertical direction of the cameras; y is level and ahead."""
    poses = path.T_world_camera
    up = unit(-poses[:, :3, 1].sum(0), -poses[0, :3, 1]) if up_world is None else up_world
    ahead = horizontal(poses[0], up)
    return np.stack([np.cross(ahead, up), ahead, up])
