"""Coordinate frames of ROS: REP 105 (map, odom), REP 103 (x forward, y left, z up; optical frames z forward).

    map ─ odom ─ camera_link ─ camera_optical_frame
     ├─ sigmasplat_world      the world of SigmaSplat: the camera of the first frame
     └─ floor                 live only, after the final map: as `levelled_map`

Only map → odom contains corrections (loops, relocalisation, mapping), so odom → camera_link is continuous.
"""

import numpy as np

from sigmasplat.data import se3
from sigmasplat.types import Matrix

MAP, ODOM, LINK, OPTICAL = "map", "odom", "camera_link", "camera_optical_frame"
WORLD, FLOOR = "sigmasplat_world", "floor"

T_LINK_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From optical axes (x right, y down, z forward) to those of a body (x forward, y left, z up); the origin is shared."""
T_MAP_WORLD = T_LINK_OPTICAL
"""From the world to the map while a run goes on: the first camera is assumed to be level."""
T_BODY_FLOOR = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""From the axes of the floor plan (x right, y ahead, z up) to x ahead, y left, z up."""


def levelled_map(T_floor_world: Matrix) -> Matrix:
    """Return T_map_world [4, 4] for a known floor: x ahead, y left, z up, origin on the floor below the first camera.

    T_floor_world: that of `FloorPlan`.
    """
    return np.asarray(T_BODY_FLOOR @ T_floor_world)


def link_pose(T_outer_optical: Matrix) -> Matrix:
    """Return the pose of camera_link, given that of the optical frame in the same outer frame [..., 4, 4]."""
    return np.asarray(T_outer_optical @ se3.inverse(T_LINK_OPTICAL))


def camera_links(T_odom_link: Matrix, T_map_link: Matrix | None) -> list[tuple[str, str, Matrix]]:
    """Return the transforms of a frame as (parent, child, pose): map → odom, left out if T_map_link is None, and odom →
    camera_link."""
    links = [(ODOM, LINK, T_odom_link)]
    if T_map_link is not None:
        links.insert(0, (MAP, ODOM, se3.orthonormalise(T_map_link @ se3.inverse(T_odom_link))))
    return links


def ros_covariance(covariance: Matrix, T_outer_world: Matrix, T_outer_link: Matrix) -> Matrix:
    """Return the covariance [6, 6] as in geometry_msgs/PoseWithCovariance: x, y, z, rotation about x, y, z, all in the
    axes of the outer frame.

    covariance [6, 6]: of the left twist (ρ, φ), m and rad, of the pose in the world; T_outer_world [4, 4]: from the
    world to the outer frame; T_outer_link [4, 4]: the pose in the outer frame.
    """
    J = se3.displacement(T_outer_link) @ se3.adjoint(T_outer_world)
    return np.asarray(J @ covariance @ J.T)
