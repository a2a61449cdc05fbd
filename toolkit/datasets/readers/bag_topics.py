"""Choice of the colour, depth and camera info topics of a bag."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from toolkit.base.errors import DatasetError
from toolkit.datasets.options import BagTopics
from toolkit.io import ros_images
from toolkit.io.bags import BagFile

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
# Parts of the names of depth that is registered to colour: realsense-ros, Azure Kinect, OpenNI.
REGISTERED_NAMES = ("aligned_depth", "depth_to_rgb", "depth_to_color", "depth_registered")
# Names by which drivers distinguish the two cameras of a stereo pair.
_OF_A_PAIR = re.compile(r"left|right|\d+")


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images.

    Attributes:
        name: of the topic.
        size: width and height in pixels.
        frame_id: name of the camera's coordinate system.
        grey: whether the images have one channel; True for depth.
        info: the first message of its camera info, or None.
    """

    name: str
    size: tuple[int, int]
    frame_id: str
    grey: bool
    info: Any | None

    @property
    def rectified(self) -> bool:
        """Whether the images are undistorted, by the name that ROS gives them."""
        return "rect" in self.base.rsplit("/", 1)[-1].lower()

    @property
    def registered(self) -> bool:
        """Whether depth is registered to colour, by the name of the topic."""
        return any(name in self.name for name in REGISTERED_NAMES)

    @property
    def base(self) -> str:
        """Name without the suffix of compressed transport."""
        return re.sub(r"/compressed(Depth)?$", "", self.name)


@dataclass(frozen=True)
class ChosenTopics:
    """Topics of a recording.

    Attributes:
        colour: colour or grey images.
        depth: depth images, None without them.
        notes: a line for each choice that was not evident.
    """

    colour: ImageTopic
    depth: ImageTopic | None
    notes: tuple[str, ...] = ()


def choose_topics(bag: BagFile, wanted: BagTopics) -> ChosenTopics:
    """Choose the topics of a bag by message types, encodings and names.

    Args:
        wanted: names given by the user; None for an automatic choice.

    Raises:
        DatasetError: a named topic does not exist, there are no colour images, or several are
            equally good.
    """
    infos = {t.name: bag.first(t.name) for t in bag.topics if t.message_type == CAMERA_INFO}
    colours: list[ImageTopic] = []
    depths: list[ImageTopic] = []
    for topic in bag.topics:
        if topic.message_type not in (ros_images.IMAGE, ros_images.COMPRESSED_IMAGE):
            continue
        message = bag.first(topic.name)
        if message is None:
            continue
        depth = ros_images.is_depth(topic.name, message)
        try:
            size, grey = ros_images.size_of(message), depth or ros_images.is_grey(message)
        except DatasetError as error:
            raise DatasetError(f"{bag.path}, {topic.name}: {error}") from error
        info = _info_of(topic.name, message, infos)
        found = ImageTopic(topic.name, size, message.header.frame_id, grey, info)
        (depths if depth else colours).append(found)
    colour, notes = _colour(bag, colours, wanted.colour)
    return ChosenTopics(colour, _depth(bag, depths, wanted.depth), notes)


def _colour(
    bag: BagFile, topics: list[ImageTopic], wanted: str | None
) -> tuple[ImageTopic, tuple[str, ...]]:
    if wanted is not None:
        return _named(bag, topics, wanted, "colour"), ()
    if not topics:
        raise DatasetError(
            f"{bag.path} has no colour images; its topics are "
            f"{_listed(topic.name for topic in bag.topics)}"
        )
    best = [topic for topic in topics if not topic.grey] or topics
    best = _preferred(best)
    if len(best) == 1:
        return best[0], ()
    if len(best) == 2 and len({_OF_A_PAIR.sub("", topic.base) for topic in best}) == 1:
        first = min(best, key=lambda topic: topic.name)
        return first, (
            f"of the two cameras, {first.name} is used; --dataset.topics.colour selects",
        )
    raise _ambiguous(bag, best, "colour")


def _depth(bag: BagFile, topics: list[ImageTopic], wanted: str | None) -> ImageTopic | None:
    if wanted is not None:
        return _named(bag, topics, wanted, "depth")
    if not topics:
        return None
    best = _preferred([topic for topic in topics if topic.registered] or topics)
    if len(best) == 1:
        return best[0]
    raise _ambiguous(bag, best, "depth")


def _preferred(topics: list[ImageTopic]) -> list[ImageTopic]:
    """Of the same images, those that are rectified and not compressed."""
    by_camera: dict[str, ImageTopic] = {}
    for topic in sorted(topics, key=lambda t: (not t.rectified, t.name != t.base, t.name)):
        by_camera.setdefault(topic.base.rsplit("/", 1)[0], topic)
    return list(by_camera.values())


def _named(bag: BagFile, topics: list[ImageTopic], name: str, what: str) -> ImageTopic:
    for topic in topics:
        if topic.name == name:
            return topic
    raise DatasetError(
        f"{bag.path} has no topic {name} with {what} images; "
        + (f"there are {_listed(t.name for t in topics)}" if topics else "there are none")
    )


def _ambiguous(bag: BagFile, topics: list[ImageTopic], what: str) -> DatasetError:
    return DatasetError(
        f"{bag.path} has several topics of {what} images "
        f"({', '.join(sorted(topic.name for topic in topics))}); select one with "
        f"--dataset.topics.{what}"
    )


def _info_of(topic: str, image: Any, infos: dict[str, Any]) -> Any | None:
    """The camera info in the innermost namespace of a topic that contains one.

    Outside of the namespaces of the image and its transport, it must be of the same camera.
    """
    parts = topic.split("/")
    for depth in range(len(parts) - 1, 0, -1):
        namespace = "/".join(parts[:depth]) + "/"
        inside = [info for name, info in infos.items() if name.startswith(namespace)]
        same = [i for i in inside if i is not None and i.header.frame_id == image.header.frame_id]
        own = depth >= len(parts) - 2 and len(inside) == 1
        found = inside if own else same
        if found and found[0] is not None:
            fits = (found[0].width, found[0].height) == ros_images.size_of(image)
            return found[0] if fits or own else None
    return None


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))
