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

from sigmasplat.api import FieldRenderer, Matrix, SigmaSplatError, Trajectory
from sigmasplat.plugins.outputs.floorplan import ground
from sigmasplat.plugins.outputs.floorplan.ground import Edge as Edge
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


def levelled(reader: RunReader, edge: Edge = "auto") -> tuple[Matrix, str, bool]:
    """Return R_floor_world [3, 3] of a run, x right, y ahead along the walls, z up; how up was found, in words; and
    whether level surfaces or an accelerometer confirm it.

    The vertical direction comes from the floor and the walls of the map, rendered along the path, and is the same in
    every export and in the floor plan. They are looked for near the direction of `up_of`, which is used alone if no
    surface is visible. Raises RunError if the run has no map or no path.
    """
    field, path, config = reader.run.read_map(), reader.valid_path(), reader.config
    up = ground.up_of(path.T_world_camera, reader.run.facts(), edge)
    samples = list(ground.sample_surfaces(field, path, reader.camera, FieldRenderer(config.render, config.backend)))
    try:
        R = ground.floor_frame(samples, up)[:3, :3]
        share = ground.level_share(samples, R[2])
    except SigmaSplatError:
        R, share = level_cameras(path, up), 0.0
    level = share > ground.MIN_LEVEL_SHARE
    found = f"{share:.0%} of what is seen is level" if level else "no floor and no table confirms it"
    return R, f"up is {up.how}; {found}", level or up.within_cos == ground.MEASURED_COS


def level_cameras(path: Trajectory, up: ground.Up | None = None) -> Matrix:
    """Return R_floor_world [3, 3] without a map: z is up, by default as the cameras are held; y is level and ahead."""
    poses = path.T_world_camera
    z = (up or ground.up_of(poses)).up
    ahead = ground.horizontal(poses[0], z)
    return np.stack([np.cross(ahead, z), ahead, z])
