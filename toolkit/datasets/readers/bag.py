"""Bags of ROS 1, ROS 2 and RealSense: colour, optional depth and camera info.

The names of a RealSense recording are those that librealsense writes
(`src/media/ros/ros_file_format.h`): `/device_0/sensor_1/Color_0/image/data`,
`.../info/camera_info` and `/device_0/sensor_0/option/Depth Units/value`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.options import BagTopics
from toolkit.datasets.pairing import associate
from toolkit.datasets.readers.bag_camera import BagCamera, camera_of, differs
from toolkit.datasets.readers.bag_topics import ChosenTopics, ImageTopic, choose_topics
from toolkit.datasets.readers.folder import read_intrinsics
from toolkit.datasets.readers.video import typical_camera
from toolkit.io import ros_images
from toolkit.io.bags import BagFile, MessagePosition

# Maximum time difference of colour and depth images.
MAX_DIFFERENCE_S = 0.02
_DEPTH_UNITS = "/option/Depth Units/value"
_MILLIMETRE = 0.001


@dataclass(frozen=True)
class BagImages:
    """Reads the images of a bag by the number of the frame.

    Attributes:
        bag: the bag.
        colour_topic, depth_topic: names of the topics.
        colour, depth: position of each frame's messages; `depth` is empty without depth.
        metres_per_value: unit of integer depth.
    """

    bag: BagFile
    colour_topic: str
    depth_topic: str | None
    colour: tuple[MessagePosition, ...]
    depth: tuple[MessagePosition, ...]
    metres_per_value: float

    def rgb(self, number: int) -> NDArray[np.float32]:
        """Decode the colour image of frame `number`.

        Raises:
            DatasetError: it is damaged or of an encoding that is not supported.
        """
        message = self.bag.message(self.colour_topic, self.colour[number])
        try:
            return ros_images.colour_of(message)
        except DatasetError as error:
            raise _located(self.bag, self.colour_topic, number, error) from error

    def depth_m(self, number: int) -> NDArray[np.float32]:
        """Decode the depth image of frame `number`.

        Raises:
            DatasetError: it is damaged or of an encoding that is not supported.
        """
        assert self.depth_topic is not None
        message = self.bag.message(self.depth_topic, self.depth[number])
        try:
            return ros_images.depth_m_of(message, self.metres_per_value)
        except DatasetError as error:
            raise _located(self.bag, self.depth_topic, number, error) from error


def describe(path: Path, topics: BagTopics | None = None) -> Recording:
    """Describe the images of a bag: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.

    A frame has the time of its colour image's header. Depth is paired with it by the smallest
    difference of time, at most 20 ms; colour without depth is left out. Depth must be registered
    to colour: of the same size and camera. Intrinsics are those of the camera info, or of a file
    beside the bag with its name and the suffix `.yaml`, which has the keys of `intrinsics.yaml`.

    Args:
        path: the bag, or a folder that contains only one.
        topics: names of topics; by default, they are chosen automatically.

    Raises:
        DatasetError: the bag is damaged, has no images, or its topics are ambiguous.
        DependencyError: rosbags is not installed.
    """
    bag = BagFile(path)
    chosen = choose_topics(bag, topics or BagTopics())
    lens, notes = _lens(bag, chosen.colour)
    fault = _depth_fault(chosen, lens)
    depth_topic = chosen.depth.name if chosen.depth and not fault else None
    found = bag.positions([chosen.colour.name, *([depth_topic] if depth_topic else [])])
    colour, late = _ascending(found[chosen.colour.name])
    flaws = (
        [f"{late} image(s) of {chosen.colour.name} are not in the order of time"] if late else []
    )
    depth: list[MessagePosition] = []
    if depth_topic:
        colour, depth, unpaired = _paired(colour, _ascending(found[depth_topic])[0])
        if not colour:
            fault, depth_topic = (
                f"no image of {chosen.colour.name} and {depth_topic} is within "
                f"{1000 * MAX_DIFFERENCE_S:.0f} ms; record both with synchronised clocks",
                None,
            )
            colour = _ascending(found[chosen.colour.name])[0]
        elif unpaired:
            notes += (f"{unpaired} colour image(s) without depth within 20 ms",)
    unit = _metres_per_value(bag)
    images = BagImages(bag, chosen.colour.name, depth_topic, tuple(colour), tuple(depth), unit)
    return Recording(
        name=bag.path.stem,
        camera=lens.camera,
        files=tuple(
            FrameFiles(position.stamp_s, bag.path, bag.path if depth_topic else None, number=n)
            for n, position in enumerate(colour)
        ),
        depth_scale=1.0 / unit,
        distortion=lens.distortion,
        fisheye=lens.fisheye,
        container=images,
        depth_fault=fault,
        flaws=tuple(flaws),
        notes=chosen.notes + notes,
        calibrated=lens.calibrated,
        focal_sigma=lens.focal_sigma,
    )


def _lens(bag: BagFile, topic: ImageTopic) -> tuple[BagCamera, tuple[str, ...]]:
    """Intrinsics of the colour images, and a note about their source."""
    file = bag.path.with_suffix(".yaml")
    if file.exists():
        intrinsics = read_intrinsics(file, has_depth=False)
        if intrinsics.camera.size != topic.size:
            raise DatasetError(
                f"{file} is for {intrinsics.camera.width}x{intrinsics.camera.height} pixels but "
                f"{topic.name} has {topic.size[0]}x{topic.size[1]}; correct the file"
            )
        lens = BagCamera(intrinsics.camera, intrinsics.distortion, intrinsics.fisheye)
        return lens, ()
    known = camera_of(topic)
    if known is None:
        lens = BagCamera(typical_camera(*topic.size), calibrated=False)
        return lens, (f"no camera info of {topic.name}; the focal length is estimated",)
    if not known.calibrated:
        return known, (
            f"no camera info of {topic.name}; nominal intrinsics of a T265 are used, and the focal "
            f"length is estimated",
        )
    return known, ()


def _depth_fault(chosen: ChosenTopics, lens: BagCamera) -> str | None:
    """Why depth is not registered to colour, or None."""
    colour, depth = chosen.colour, chosen.depth
    if depth is None:
        return None
    remedy = (
        "record depth that is registered to colour (RealSense: align_depth.enable:=true and the "
        "topic .../aligned_depth_to_color/image_raw), or use colour alone with --depth none"
    )
    if depth.size != colour.size:
        return (
            f"depth ({depth.name}, {depth.size[0]}x{depth.size[1]}) is not registered to colour "
            f"({colour.name}, {colour.size[0]}x{colour.size[1]}); {remedy}"
        )
    own = camera_of(depth)
    if own is None or not lens.calibrated or not differs(lens.camera, own.camera):
        return None
    return (
        f"depth ({depth.name}, f {own.camera.fx:.1f}) is not registered to colour ({colour.name}, "
        f"f {lens.camera.fx:.1f}); {remedy}"
    )


def _ascending(positions: list[MessagePosition]) -> tuple[list[MessagePosition], int]:
    """Messages in the order of their stamps without repeated ones, and the number left out.

    Without stamps, the time of recording serves.
    """
    if not any(position.stamp_s > 0 for position in positions):
        positions = [
            MessagePosition(p.recorded_ns, p.repeat, 1e-9 * p.recorded_ns + 1e-6 * p.repeat)
            for p in positions
        ]
    by_time = {position.stamp_s: position for position in positions}
    ordered = [by_time[time] for time in sorted(by_time)]
    return ordered, len(positions) - len(ordered)


def _paired(
    colour: list[MessagePosition], depth: list[MessagePosition]
) -> tuple[list[MessagePosition], list[MessagePosition], int]:
    """Colour and depth of each frame, and the number of colour images without depth."""
    times = [np.array([p.stamp_s for p in positions]) for positions in (colour, depth)]
    pairs = associate(times[0], times[1], MAX_DIFFERENCE_S)
    alone = len(colour) - len(pairs)
    return [colour[i] for i, _ in pairs], [depth[j] for _, j in pairs], alone


def _metres_per_value(bag: BagFile) -> float:
    """Unit of integer depth: that of a RealSense recording, or millimetres."""
    for topic in bag.topics:
        message = bag.first(topic.name) if topic.name.endswith(_DEPTH_UNITS) else None
        if message is not None and 0 < message.data < float("inf"):
            return float(message.data)
    return _MILLIMETRE


def _located(bag: BagFile, topic: str, number: int, error: DatasetError) -> DatasetError:
    return DatasetError(f"{bag.path}, {topic}, frame {number}: {error}")
