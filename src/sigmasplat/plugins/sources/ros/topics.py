"""Choose the colour and the depth topic of a bag: by message content, then by topic name."""

from collections.abc import Callable
from dataclasses import dataclass

from sigmasplat.errors import SourceError, nearest
from sigmasplat.plugins.sources.ros.bag import Bag, list_topics
from sigmasplat.plugins.sources.ros.images import COMPRESSED, RAW, ImageKind, image_kind, message_size

REGISTERED_NAMES = ("aligned_depth_to_color", "depth_registered", "depth_to_rgb")
"""Parts of topic names for depth registered to colour (RealSense; OpenNI, Kinect; Azure Kinect)."""
NOT_DEPTH_NAMES = ("infra", "/ir/", "confidence")
"""Parts of topic names for 16-bit images that are not depth."""


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images: their kind, optical frame, and (width, height) of the first image."""

    name: str
    kind: ImageKind
    frame: str
    size: tuple[int, int]

    @property
    def base(self) -> str:
        """The topic name without the suffix that image_transport adds to compressed images."""
        return self.name.removesuffix("/compressedDepth").removesuffix("/compressed")

    @property
    def camera(self) -> str:
        """The name space of all images of one camera."""
        return self.base.rpartition("/")[0]

    @property
    def registered(self) -> bool:
        """Whether its name says that depth is registered to colour."""
        return any(words in self.name for words in REGISTERED_NAMES)


def color_topic(bag: Bag, requested: str) -> ImageTopic:
    """Return the requested topic, or the only one with colour images. Raises SourceError if it is ambiguous."""
    found = [topic_by_name(bag, requested)] if requested else image_topics(bag, "colour")
    best = _preferred(found, lambda topic: not any(word in topic.name.lower() for word in ("color", "rgb")))
    return _one_camera(bag, "colour", best, "color")


def depth_topic(bag: Bag, requested: str) -> ImageTopic:
    """Return the requested topic, or the only one with depth; depth registered to colour is preferred.

    Raises SourceError if there is no such topic or more than one.
    """
    if requested:
        return _one_camera(bag, "depth", [topic_by_name(bag, requested)], "depth")
    found = [
        topic for topic in image_topics(bag, "depth") if not any(word in topic.name.lower() for word in NOT_DEPTH_NAMES)
    ]
    return _one_camera(bag, "depth", _preferred(found, lambda topic: not topic.registered), "depth")


def image_topics(bag: Bag, kind: ImageKind) -> list[ImageTopic]:
    """Return the topics whose first message is of this kind. Raises SourceError if the bag is damaged."""
    found = [_described(bag, topic.name) for topic in bag.topics_of_type(RAW, COMPRESSED)]
    return [topic for topic in found if topic.kind == kind]


def topic_by_name(bag: Bag, name: str) -> ImageTopic:
    """Return a topic by name. Raises SourceError if it does not exist or holds no images."""
    topics = {topic.name: topic for topic in bag.topics_of_type(RAW, COMPRESSED)}
    if name not in topics:
        raise SourceError(
            f"{bag.path}: no images in topic {name}{nearest(name, list(topics))}; "
            f"there are {list_topics(topics.values())}"
        )
    return _described(bag, name)


def _described(bag: Bag, name: str) -> ImageTopic:
    message = bag.first_message(name)
    size = message_size(bag.path / name.lstrip("/"), message)
    return ImageTopic(name, image_kind(message), message.header.frame_id.lstrip("/"), size)


def _preferred(topics: list[ImageTopic], worse: Callable[[ImageTopic], bool]) -> list[ImageTopic]:
    """Return the topics that are not worse, or all topics if every one is."""
    return [topic for topic in topics if not worse(topic)] or topics


def _one_camera(bag: Bag, what: str, topics: list[ImageTopic], option: str) -> ImageTopic:
    """Return the topic of the only camera: rectified before raw, uncompressed before compressed."""
    if not topics or any(topic.kind != what for topic in topics):
        raise SourceError(
            f"{bag.path}: no {what} images in {topics[0].name if topics else 'any topic'}; "
            f"the bag holds {list_topics(bag.topics.values())}"
        )
    cameras = sorted({topic.camera for topic in topics})
    if len(cameras) > 1:
        names = ", ".join(sorted(topic.name for topic in topics))
        raise SourceError(f"{bag.path}: several topics hold {what} images ({names}); choose one: --{option}-topic NAME")
    return min(topics, key=lambda topic: ("rect" not in topic.base, topic.base != topic.name, topic.name))
