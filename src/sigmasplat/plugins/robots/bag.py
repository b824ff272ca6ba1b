"""Write ROS 2 messages, through the rosbags package (Apache-2.0).

A run that goes on writes a bag: a folder with metadata.yaml and one MCAP file. A finished run is exported as that file
alone."""

import os
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from sigmasplat.api import (
    Matrix,
    PathCovariance,
    Progress,
    RunError,
    SigmaSplatError,
    Trajectory,
    import_optional,
    no_progress,
    noted_up,
    replacing,
)
from sigmasplat.plugins.outputs.axes import level_cameras
from sigmasplat.plugins.outputs.floorplan.floor_plan import FloorPlan, run_floor_plan
from sigmasplat.plugins.outputs.run_reader import RunReader
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
        if self._bytes > CHUNK_BYTES:
            self._complete_chunk()

    def close(self) -> None:
        """Write the index and metadata.yaml. Raises OSError if the disk is full."""
        self.writer.close()

    def abort(self) -> None:
        """Close the file without an index; `mcap recover` reads what was written."""
        with suppress(Exception):
            self.writer.abort()

    def _complete_chunk(self) -> None:
        """Write the messages so far to the disk, so that little is lost if the process is killed.

        By itself, the library does this after 1 MB, which are minutes of poses. A later version may have other names.
        """
        self._bytes = 0
        with suppress(AttributeError):
            self.writer.storage.close_chunk()
            self.writer.storage.bio.flush()

    def _quality(self, topic: Topic) -> Any:
        kinds, no_limit = self.interfaces, self.interfaces.QosTime(2147483647, 4294967295)
        durability = kinds.QosDurability.TRANSIENT_LOCAL if topic.latched else kinds.QosDurability.VOLATILE
        return kinds.Qos(
            kinds.QosHistory.KEEP_LAST, 1 if topic.latched else 100, kinds.QosReliability.RELIABLE, durability,
            no_limit, no_limit, kinds.QosLiveliness.AUTOMATIC, no_limit, False,
        )  # fmt: skip


def export_bag(
    reader: RunReader, target: Path, *, pictures: bool = False, progress: Progress = no_progress
) -> dict[str, int]:
    """Write an MCAP file; return the number of messages of each topic.

    pictures: also write the images of the keyframes. Calls `progress(poses done, total)` while the floor plan is made.
    Raises RunError if the run has no path or map, or if the target cannot be written; SourceError without the rosbags
    package.
    """
    messages, counts = RosMessages(), Counter[str]()
    with replacing(target) as temporary:
        folder = temporary.with_name(f"{temporary.name}-bag")  # of its files only the MCAP file is kept
        try:
            shutil.rmtree(folder, ignore_errors=True)  # of a process that was killed
            sink = BagSink(folder)
            sink.open(messages)
            try:
                for message in _messages(reader, messages, pictures, progress):
                    sink.write(message)
                    counts[message.topic.name] += 1
                sink.close()
            except BaseException:
                sink.abort()
                raise
            (folder / f"{folder.name}.mcap").replace(temporary)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    return counts


def _messages(reader: RunReader, messages: RosMessages, pictures: bool, progress: Progress) -> Iterator[Encoded]:
    """Yield the messages of a run in order of time; the map comes first, so that a player has it from the start."""
    plan, T_floor_world = _floor(reader, progress)
    T_map_world = ros.levelled_map(T_floor_world)
    first_ns = ros.stamp_of(reader.frames.log[0]["timestamp_s"])
    static = [(ros.MAP, ros.WORLD, T_map_world), (ros.LINK, ros.OPTICAL, ros.T_LINK_OPTICAL)]
    yield messages.transforms(ros.TF_STATIC, first_ns, static)
    field, std = reader.run.read_splat_std() or (reader.run.read_map(), None)
    yield messages.cloud(first_ns, ros.MAP, field, None if std is None else std.depth_std_m, T_map_world)
    if plan is not None:
        yield messages.grid(first_ns, ros.MAP, plan)
    yield from _frames(reader, messages, T_map_world, pictures)


def _frames(reader: RunReader, messages: RosMessages, T_map_world: Matrix, pictures: bool) -> Iterator[Encoded]:
    """Yield the messages of the frames: transform and pose with covariance of valid ones, images of keyframes."""
    images = reader.keyframes() if pictures else iter(())
    picture = next(images, None)
    path = PathCovariance.of(reader.run.read_checkpoint()[0])
    valid_links = ros.link_pose(T_map_world @ reader.valid_path().T_world_camera)
    valid = dict(zip(reader.valid_frames(), valid_links, strict=True))
    for row, record in enumerate(reader.frames.log):
        stamp_ns = ros.stamp_of(record["timestamp_s"])
        if picture is not None and picture[0] == row:
            yield from messages.images(stamp_ns, reader.camera, picture[1].unit_color, picture[1].depth_m)
            picture = next(images, None)
        if row in valid:
            covariance = None if path is None else ros.ros_covariance(path.of_frame(row), T_map_world, valid[row])
            yield messages.transforms(ros.TF, stamp_ns, [(ros.MAP, ros.LINK, valid[row])])
            yield messages.pose(stamp_ns, ros.MAP, valid[row], covariance)


def _floor(reader: RunReader, progress: Progress) -> tuple[FloorPlan | None, Matrix]:
    """Return the floor plan and T_floor_world; if no surface is visible, no plan, and axes levelled by the cameras."""
    path: Trajectory = reader.valid_path()
    with suppress(SigmaSplatError):
        plan = run_floor_plan(reader.run, path, reader.camera, progress=progress)
        return plan, plan.T_floor_world
    T = np.eye(4)
    T[:3, :3] = level_cameras(path, noted_up(reader.run.facts()))
    return None, T
