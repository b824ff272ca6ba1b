"""Write ROS 2 messages as a bag, through the rosbags package (Apache-2.0): of a running or of a finished run.

A bag is a folder with metadata.yaml and one MCAP file, or the MCAP file alone."""

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sigmasplat.api import (
    LOST,
    RELOCALISED,
    Matrix,
    PathCovariance,
    Progress,
    RunError,
    SigmaSplatError,
    Trajectory,
    import_optional,
    no_progress,
    noted_up,
    se3,
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


FILE_ENDING = ".mcap"


def export_bag(
    reader: RunReader, target: Path, *, pictures: bool = False, progress: Progress = no_progress
) -> dict[str, int]:
    """Write a bag, or one MCAP file if `target` ends in .mcap; return the number of messages of each topic.

    pictures: also write the images of the keyframes. Calls `progress(poses done, total)` while the floor plan is made.
    Raises RunError if the run has no path or map, or if the target cannot be written; SourceError without the rosbags
    package.
    """
    messages = RosMessages()
    one_file = target.suffix == FILE_ENDING
    folder = target.with_name(f".{target.name}.part")
    shutil.rmtree(folder, ignore_errors=True)
    counts = dict[str, int]()
    try:
        folder.mkdir()
        bag = folder / target.name.removesuffix(FILE_ENDING)
        sink = BagSink(bag)
        sink.open(messages)
        try:
            for message in _messages(reader, messages, pictures, progress):
                sink.write(message)
                counts[message.topic.name] = counts.get(message.topic.name, 0) + 1
            sink.close()
        except BaseException:
            sink.abort()
            raise
        _remove_earlier(target)
        (bag / f"{bag.name}{FILE_ENDING}" if one_file else bag).rename(target)
    except OSError as problem:
        raise RunError(f"cannot write {target}: {problem.strerror or problem}; choose a writable place") from problem
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return counts


def _remove_earlier(target: Path) -> None:
    if not target.is_dir():
        return target.unlink(missing_ok=True)
    for name in ("metadata.yaml", f"{target.name}{FILE_ENDING}"):
        (target / name).unlink(missing_ok=True)
    target.rmdir()


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
    """Yield the messages of the frames: transforms, odometry, pose with covariance, images of keyframes."""
    images = reader.keyframes() if pictures else iter(())
    picture = next(images, None)
    tensors = reader.run.read_checkpoint()[0]
    T_odom_camera, tracked = _odometry(reader, tensors)
    path = PathCovariance.of(tensors)
    chain = None if path is None else path.without_loops()
    valid_links = ros.link_pose(T_map_world @ reader.valid_path().T_world_camera)
    valid = dict(zip(reader.valid_frames(), valid_links, strict=True))
    for row, record in enumerate(reader.frames.log):
        stamp_ns = ros.stamp_of(record["timestamp_s"])
        if picture is not None and picture[0] == row:
            yield from messages.images(stamp_ns, reader.camera, picture[1].unit_color, picture[1].depth_m)
            picture = next(images, None)
        if reader.frames.states[row] == LOST:
            continue
        T_odom_link, T_map_link = ros.link_pose(ros.T_LINK_OPTICAL @ T_odom_camera[row]), valid.get(row)
        covariance = None
        if chain is not None and tracked[row]:
            covariance = ros.ros_covariance(chain.of_frame(row), ros.T_LINK_OPTICAL, T_odom_link)
        yield messages.transforms(ros.TF, stamp_ns, ros.camera_links(T_odom_link, T_map_link))
        yield messages.odometry(stamp_ns, ros.ODOM, ros.LINK, T_odom_link, covariance)
        if T_map_link is not None:
            covariance = None if path is None else ros.ros_covariance(path.of_frame(row), T_map_world, T_map_link)
            yield messages.pose(stamp_ns, ros.MAP, T_map_link, covariance)


FOUND_BY_FEATURES = "inliers"
"""A step has this value if relocalisation decided its pose."""


def has_motion(state: str, tracking: Mapping[str, float]) -> bool:
    """Return whether tracking measured the motion to a frame from an earlier one, given the values of its step.

    A lost frame has only a guess, and a relocalised one was found without an earlier frame. A frame that is tracked
    again after lost ones has a motion: it is tracked from the same keyframe as the frames before them.
    """
    return state not in (LOST, RELOCALISED) and FOUND_BY_FEATURES not in tracking


def odometry_poses(
    T_chain_camera: Matrix, moved: Sequence[bool], lost: Sequence[bool], components: Sequence[int]
) -> tuple[Matrix, NDArray[np.bool_]]:
    """Return T_odom_camera [F, 4, 4] of a finished path, the identity at the first frame, and whether all motions up to
    each frame were tracked [F].

    T_chain_camera [F, 4, 4]: poses without corrections by loops; moved [F]: `has_motion` of each frame; lost [F];
    components [F]. Motion that was not tracked is left out. A lost frame stays at the pose of the frame before.
    """
    poses, last = [np.eye(4)] if len(T_chain_camera) else [], 0
    tracked = np.ones(len(T_chain_camera), np.bool_)
    for i in range(1, len(T_chain_camera)):
        tracked[i] = lost[i] or (moved[i] and components[i] == components[last])
        pose = poses[-1]
        if tracked[i] and not lost[i]:
            pose = se3.orthonormalise(pose @ se3.inverse(T_chain_camera[last]) @ T_chain_camera[i])
        poses.append(pose)
        last = last if lost[i] else i
    return np.array(poses).reshape(-1, 4, 4), np.logical_and.accumulate(tracked)


def _odometry(reader: RunReader, tensors: Mapping[str, Tensor]) -> tuple[Matrix, NDArray[np.bool_]]:
    """Return T_odom_camera [F, 4, 4] of all frames, and whether all motions up to each frame were tracked [F]."""
    frames = reader.frames
    chain = tensors.get("T_world_camera_odometry", tensors["T_world_camera"]).numpy()
    if len(chain) < len(frames):
        run = reader.run.path
        raise RunError(f"{run}: {len(chain)} poses in the checkpoint for {len(frames)} frames; run it again")
    components = [0] * len(frames)
    if "submap_component" in tensors:
        components = tensors["submap_component"][tensors["frame_submap"]].tolist()
    lost = [state == LOST for state in frames.states]
    moved = [has_motion(s, r.get("tracking", {})) for s, r in zip(frames.states, frames.log, strict=True)]
    return odometry_poses(chain[: len(frames)], moved, lost, components)


def _floor(reader: RunReader, progress: Progress) -> tuple[FloorPlan | None, Matrix]:
    """Return the floor plan and T_floor_world; if no surface is visible, no plan, and axes levelled by the cameras."""
    path: Trajectory = reader.valid_path()
    with suppress(SigmaSplatError):
        plan = run_floor_plan(reader.run, path, reader.camera, progress=progress)
        return plan, plan.T_floor_world
    T = np.eye(4)
    T[:3, :3] = level_cameras(path, noted_up(reader.run.facts()))
    return None, T
