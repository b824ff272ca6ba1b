"""Write a run that goes on to a bag: transforms, odometry, loops, images, and the map as points and as a grid."""

import contextlib
from array import array
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Literal

import numpy as np

from sigmasplat.api import (
    Callback,
    Frame,
    Loop,
    Matrix,
    PathCovariance,
    SigmaSplatError,
    Slam,
    Step,
    path_errors,
    se3,
    up_of_path,
)
from sigmasplat.plugins.outputs.floorplan.floor_plan import FloorPlan, map_floor_plan
from sigmasplat.plugins.robots import ros_messages as ros
from sigmasplat.plugins.robots.odometry import LiveOdometry, has_motion
from sigmasplat.plugins.robots.outlet import Outlet
from sigmasplat.plugins.robots.ros_messages import MAX_POINTS, Encoded, Points, RosMessages

Images = Literal["none", "keyframes", "all"]
SUBMAP_POINTS = 20_000
"""At most this many points of each submap while the run goes on; fewer if there are many submaps."""
STATIC = ((ros.MAP, ros.WORLD, ros.T_MAP_WORLD), (ros.LINK, ros.OPTICAL, ros.T_LINK_OPTICAL))
"""Each message of static transforms contains all of them, because late subscribers get only the last one."""


class LiveRobot(Callback):
    """Gives messages to an outlet.

    It copies small data in the thread of the run. Messages are made and written on the thread of the outlet. images:
    of which frames images are given. warn: prints a line if the outlet fails.
    """

    def __init__(self, slam: Slam, outlet: Outlet, warn: Callable[[str], None], images: Images = "keyframes") -> None:
        self.slam, self.outlet, self.warn, self.images = slam, outlet, warn, images
        self.odometry = LiveOdometry(slam.atlas)
        self._frames = dict[int, Frame]()
        self._rows, self._forces_m_s2 = array("q"), array("d")  # of the steps with a force on their frame
        self._submaps = list[Callable[[], Points]]()  # in their own frames, each read once
        self._stamp_ns = -1
        self._warned = False

    def watch(self, frame: Frame) -> None:
        """Keep a frame until its step, if its images or the force on it may be wanted."""
        if self.images != "none" or frame.specific_force_m_s2 is not None:
            self._frames[frame.index] = frame

    def __call__(self, step: Step) -> None:
        """Give the messages of a step to the outlet."""
        self._now(step.timestamp_s)
        self._offer_images(step, self._frame_of(step))
        moved = has_motion(step.state, step.tracking)
        T_odom_camera = self.odometry.step(moved, step.lost, step.is_keyframe)
        if not step.lost:
            self._offer_pose(step, T_odom_camera)
        if any(loop.accepted for loop in step.loops):
            self._offer_loop(len(self.slam.steps) - 1)
        self._offer_submaps(step.submap)
        self._report_failure()

    def last_loops(self, loops: Sequence[Loop]) -> None:
        """Give the final map, and the last pose if the last loops have moved it."""
        self._now(self.slam.steps[-1].timestamp_s)
        if any(loop.accepted for loop in loops):
            self._offer_loop(len(self.slam.steps) - 1)
        self._offer_final_map()

    def close(self) -> None:
        """Write what waits, and report if the outlet failed."""
        self.outlet.close()
        self._report_failure()

    # ---- in the thread of the run; jobs are called on the thread of the outlet ----

    def _now(self, timestamp_s: float) -> None:
        """Set the time of the next messages; the first time, give the static transforms."""
        first, self._stamp_ns = self._stamp_ns < 0, ros.stamp_of(timestamp_s)
        if first:
            self._offer_static(STATIC)

    def _offer_static(self, links: Sequence[tuple[str, str, Matrix]]) -> None:
        stamp_ns = self._stamp_ns
        self.outlet.offer(lambda messages: [messages.transforms(ros.TF_STATIC, stamp_ns, links)])

    def _frame_of(self, step: Step) -> Frame | None:
        """Return the frame of a step if it was kept, and note the force on it; forget those that real time dropped."""
        frame = self._frames.pop(step.index, None)
        for index in list(self._frames):  # a copy: in real time `watch` runs on another thread
            if index < step.index:
                del self._frames[index]
        if frame is not None and frame.specific_force_m_s2 is not None:
            self._rows.append(len(self.slam.steps) - 1)
            self._forces_m_s2.extend(frame.specific_force_m_s2)
        return frame

    def _offer_images(self, step: Step, frame: Frame | None) -> None:
        wanted = self.images == "all" or (self.images == "keyframes" and step.is_keyframe)
        if frame is not None and wanted:
            image = self._stamp_ns, frame.camera, frame.color, frame.depth_m
            self.outlet.offer(lambda messages: messages.images(*image), bulky=True)

    def _offer_pose(self, step: Step, T_odom_camera: Matrix) -> None:
        """Give the transforms and the odometry of a frame that is not lost.

        If the frame's component is not connected to the world, map → odom is not known and left out.
        """
        T_odom_link = ros.link_pose(ros.T_LINK_OPTICAL @ T_odom_camera)
        links = ros.camera_links(
            T_odom_link, None if step.component else ros.link_pose(ros.T_MAP_WORLD @ step.T_world_camera)
        )
        known = self.odometry.covariance
        covariance = None if known is None else ros.ros_covariance(known, ros.T_LINK_OPTICAL, T_odom_link)
        stamp_ns = self._stamp_ns

        def job(messages: RosMessages) -> list[Encoded]:
            odometry = messages.odometry(stamp_ns, ros.ODOM, ros.LINK, T_odom_link, covariance)
            return [messages.transforms(ros.TF, stamp_ns, links), odometry]

        self.outlet.offer(job)

    def _offer_loop(self, row: int) -> None:
        """Give the pose of a frame in the map with its covariance; this is computed on the outlet's thread."""
        slam, stamp_ns = self.slam, self._stamp_ns
        if not slam.atlas.in_world[row]:
            return
        errors = path_errors(slam.atlas, slam.keyframe_indices, slam.closer.valid)

        def job(messages: RosMessages) -> list[Encoded]:
            path = PathCovariance.of(errors)
            assert path is not None
            T_map_link = ros.link_pose(ros.T_MAP_WORLD @ path.T_world_camera[row])
            covariance = ros.ros_covariance(path.of_frame(row), ros.T_MAP_WORLD, T_map_link)
            return [messages.pose(ros.LOOP, stamp_ns, ros.MAP, T_map_link, covariance)]

        self.outlet.offer(job)

    def _offer_submaps(self, finished: int) -> None:
        """Give the points of all finished submaps of the world, when one more is finished; they are read on the thread
        of the outlet."""
        if len(self._submaps) == finished:
            return
        atlas = self.slam.atlas
        self._submaps += [cache(partial(self._read_points, s)) for s in range(len(self._submaps), finished)]
        parts = [
            (points, ros.T_MAP_WORLD @ atlas.anchors[s])
            for s, points in enumerate(self._submaps)
            if not atlas.components[s]
        ]
        stamp_ns = self._stamp_ns

        def job(messages: RosMessages) -> list[Encoded]:
            each = MAX_POINTS // len(parts)
            moved = [points().thinned(each).moved(T) for points, T in parts]
            return [messages.cloud(stamp_ns, ros.MAP, Points.joined(moved))]

        if parts:
            self.outlet.offer(job)

    def _read_points(self, submap: int) -> Points:
        return ros.points_of(self.slam.store.load(submap).field, None, SUBMAP_POINTS)

    def _offer_final_map(self) -> None:
        field, known, stamp_ns = self.slam.field, self.slam.uncertainty, self._stamp_ns
        std = None if known is None or known.std is None else known.std.depth_std_m

        def job(messages: RosMessages) -> list[Encoded]:
            return [messages.cloud(stamp_ns, ros.MAP, ros.points_of(field, std).moved(ros.T_MAP_WORLD))]

        self.outlet.offer(job)
        plan = self._floor_plan()
        if plan is not None:
            floor = (ros.MAP, ros.FLOOR, ros.T_MAP_WORLD @ se3.inverse(ros.levelled_map(plan.T_floor_world)))
            self._offer_static((*STATIC, floor))
            self.outlet.offer(partial(ros.grids, plan, stamp_ns, ros.FLOOR))

    def _floor_plan(self) -> FloorPlan | None:
        slam = self.slam
        whole, valid = slam.trajectory(), slam.valid()
        path, rows = whole.at(valid), np.array(self._rows, np.intp)
        known, forces = valid[rows], np.array(self._forces_m_s2).reshape(-1, 3)
        up_world = up_of_path(whole.T_world_camera[rows[known]], forces[known])
        if not len(path):
            return None
        with contextlib.suppress(SigmaSplatError):
            return map_floor_plan(
                slam.field, slam.uncertainty, slam.config, path, slam.view.camera, up_world=up_world
            )  # fmt: skip
        return None

    def _report_failure(self) -> None:
        if self.outlet.failure and not self._warned:
            self._warned = True
            self.warn(f"the bag ended ({self.outlet.failure}) after {self.outlet.written} messages; the run goes on")
