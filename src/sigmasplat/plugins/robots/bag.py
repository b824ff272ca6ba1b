"""Write a run that goes on to a bag: transforms, odometry, images. An error of the disk ends the bag, not the run.

A bag is a folder with metadata.yaml and one MCAP file, which the rosbags package (Apache-2.0) writes.
"""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sigmasplat.api import LOST, RELOCALISED, Atlas, Callback, Frame, Matrix, RunError, Slam, Step, import_optional, se3
from sigmasplat.plugins.robots import ros_messages as ros
from sigmasplat.plugins.robots.ros_messages import Encoded, RosMessages, Topic

CHUNK_BYTES = 65_536


class BagSink:
    """A bag in a new folder, with all topics, also those without messages. Chunks are compressed with Zstandard."""

    def __init__(self, folder: Path) -> None:
        """Raises SourceError without the rosbags package, RunError if the folder exists or cannot be made."""
        self.rosbag2 = import_optional("rosbags.rosbag2", ros.EXTRA, "a ROS bag")
        self.interfaces = import_optional("rosbags.interfaces", ros.EXTRA, "a ROS bag")
        self.folder = folder
        if folder.suffix == ".mcap":
            raise RunError(f"{folder}: a bag is a folder; give its name without .mcap")
        if folder.exists():
            raise RunError(f"{folder} exists; give another folder for the bag")
        if not (folder.parent.is_dir() and os.access(folder.parent, os.W_OK)):
            raise RunError(f"cannot write the bag {folder}: {folder.parent} is not a writable folder")
        self.writer: Any = None
        self.connections = dict[str, Any]()
        self._bytes = 0

    def open(self, messages: RosMessages) -> None:
        """Create the folder and its topics. Raises OSError if that fails."""
        library = self.rosbag2
        self.writer = library.Writer(self.folder, version=9, storage_plugin=library.StoragePlugin.MCAP)
        self.writer.set_compression(library.CompressionMode.STORAGE, library.CompressionFormat.ZSTD)
        self.writer.open()
        for topic in ros.TOPICS:
            self.connections[topic.name] = self.writer.add_connection(
                topic.name, topic.msgtype, typestore=messages.store, offered_qos_profiles=[self._quality(topic)]
            )

    def write(self, message: Encoded) -> None:
        """Write a message; its recording time is its stamp. Raises OSError if the disk is full."""
        self.writer.write(self.connections[message.topic.name], message.stamp_ns, message.data)
        self._bytes += len(message.data)
        if self._bytes > CHUNK_BYTES:  # by itself, the library writes after 1 MB, which are minutes of poses
            self._bytes = 0
            with suppress(AttributeError):  # a later version may have other names
                self.writer.storage.close_chunk()
                self.writer.storage.bio.flush()

    def close(self) -> None:
        """Write the index and metadata.yaml. Raises OSError if the disk is full."""
        self.writer.close()

    def abort(self) -> None:
        """Close the file without an index; `mcap recover` reads what was written."""
        with suppress(Exception):
            self.writer.abort()

    def _quality(self, topic: Topic) -> Any:
        kinds, no_limit = self.interfaces, self.interfaces.QosTime(2147483647, 4294967295)
        durability = kinds.QosDurability.TRANSIENT_LOCAL if topic.latched else kinds.QosDurability.VOLATILE
        return kinds.Qos(
            kinds.QosHistory.KEEP_LAST, 1 if topic.latched else 100, kinds.QosReliability.RELIABLE, durability,
            no_limit, no_limit, kinds.QosLiveliness.AUTOMATIC, no_limit, False,
        )  # fmt: skip


Images = Literal["none", "keyframes", "all"]
STATIC = ((ros.MAP, ros.WORLD, ros.T_MAP_WORLD), (ros.LINK, ros.OPTICAL, ros.T_LINK_OPTICAL))

FOUND_BY_FEATURES = "inliers"
"""A step has this value if relocalisation decided its pose."""


def has_motion(state: str, tracking: Mapping[str, float]) -> bool:
    """Return whether tracking measured the motion to a frame from an earlier one, given the values of its step.

    A lost frame has only a guess, and a relocalised one was found without an earlier frame. A frame that is tracked
    again after lost ones has a motion: it is tracked from the same keyframe as the frames before them.
    """
    return state not in (LOST, RELOCALISED) and FOUND_BY_FEATURES not in tracking


class LiveOdometry:
    """Odometry of a run that goes on: T_odom_camera [4, 4], the identity at the first frame that it is given."""

    def __init__(self, atlas: Atlas) -> None:
        self.atlas = atlas
        self.T_odom_camera = np.eye(4)
        self._last: int | None = None

    def step(self, moved: bool, lost: bool) -> Matrix:
        """Add the motion to the newest frame of the atlas; return T_odom_camera.

        moved: its `has_motion`; a lost frame adds no motion.
        """
        newest = len(self.atlas.places) - 1
        if self._last is not None and moved and not lost:
            self.T_odom_camera = se3.orthonormalise(self.T_odom_camera @ self._motion(self._last))
        self._last = newest if self._last is None or not lost else self._last
        return self.T_odom_camera

    def _motion(self, last: int) -> Matrix:
        """Return the motion to the newest frame from the last one that was not lost; none between components.

        Both poses are read now, so that changes of their keyframes by mapping are no motion.
        """
        atlas, (before, now) = self.atlas, (self.atlas.places[last], self.atlas.places[-1])
        if atlas.components[before.submap] != atlas.components[now.submap]:
            return np.eye(4)
        T = [atlas.odometry[s] @ atlas.keyframe_poses[s][k] @ T_keyframe for s, k, T_keyframe in (before, now)]
        return np.asarray(se3.inverse(T[0]) @ T[1])


class LiveRobot(Callback):
    """Writes the messages of each step to a bag, which is made at the first step.

    images: of which frames images are written; warn: prints a line if the bag fails; written: number of messages;
    failure: why the bag ended, "" if it did not.
    """

    def __init__(self, slam: Slam, folder: Path, warn: Callable[[str], None], images: Images = "keyframes") -> None:
        """Raises as BagSink."""
        self.sink, self.messages = BagSink(folder), RosMessages()
        self.warn, self.images = warn, images
        self.odometry = LiveOdometry(slam.atlas)
        self.written, self.failure = 0, ""
        self._frames = dict[int, Frame]()

    def watch(self, frame: Frame) -> None:
        """Keep a frame until its step, if its images may be wanted."""
        if self.images != "none":
            self._frames[frame.index] = frame

    def __call__(self, step: Step) -> None:
        """Write the messages of a step."""
        frame = self._frame_of(step)
        T_odom_camera = self.odometry.step(has_motion(step.state, step.tracking), step.lost)
        self._try(lambda: self._write(step, frame, T_odom_camera))

    def close(self) -> None:
        """Complete the bag."""
        if self.written:
            self._try(self.sink.close)

    def _try(self, action: Callable[[], None]) -> None:
        """Call a function that writes; if it fails, end the bag and say so."""
        if self.failure:
            return
        try:
            action()
        except Exception as problem:
            known = isinstance(problem, OSError) and problem.strerror
            self.failure = known or f"{type(problem).__name__}: {problem}".splitlines()[0]
            self.sink.abort()
            self.warn(f"the bag ended ({self.failure}) after {self.written} messages; the run goes on")

    def _write(self, step: Step, frame: Frame | None, T_odom_camera: Matrix) -> None:
        stamp_ns, made = ros.stamp_of(step.timestamp_s), list[Encoded]()
        if not self.written:
            self.sink.open(self.messages)
            made.append(self.messages.transforms(ros.TF_STATIC, stamp_ns, STATIC))
        if frame is not None and (self.images == "all" or step.is_keyframe):
            made += self.messages.images(stamp_ns, frame.camera, frame.color, frame.depth_m)
        if not step.lost:
            made += self._pose(step, stamp_ns, T_odom_camera)
        for message in made:
            self.sink.write(message)
            self.written += 1

    def _frame_of(self, step: Step) -> Frame | None:
        """Return the frame of a step if it was kept; forget those that real time dropped."""
        frame = self._frames.pop(step.index, None)
        for index in list(self._frames):  # a copy: in real time `watch` runs on another thread
            if index < step.index:
                del self._frames[index]
        return frame

    def _pose(self, step: Step, stamp_ns: int, T_odom_camera: Matrix) -> list[Encoded]:
        """Make the transforms and the odometry of a frame that is not lost.

        If the frame's component is not connected to the world, map → odom is not known and left out.
        """
        T_odom_link = ros.link_pose(ros.T_LINK_OPTICAL @ T_odom_camera)
        links = [(ros.ODOM, ros.LINK, T_odom_link)]
        if not step.component:
            T_map_link = ros.link_pose(ros.T_MAP_WORLD @ step.T_world_camera)
            links.insert(0, (ros.MAP, ros.ODOM, se3.orthonormalise(T_map_link @ se3.inverse(T_odom_link))))
        odometry = self.messages.odometry(stamp_ns, ros.ODOM, ros.LINK, T_odom_link)
        return [self.messages.transforms(ros.TF, stamp_ns, links), odometry]
