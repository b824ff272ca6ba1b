"""Write ROS 2 messages as a bag, a folder with metadata.yaml and one MCAP file, through rosbags (Apache-2.0)."""

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from sigmasplat.api import RunError, import_optional
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
