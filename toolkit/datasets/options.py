"""Options of datasets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from toolkit.base.options import Range

# Kinds of datasets, and the module of `readers` that describes each.
READERS = {
    "synthetic": "replica",
    "tum": "tum",
    "replica": "replica",
    "seven-scenes": "seven_scenes",
    "scannet": "scannet",
    "nerfstudio": "nerfstudio",
    "stray-scanner": "stray_scanner",
    "record3d": "record3d",
    "polycam": "polycam",
    "colmap": "colmap",
    "folder": "folder",
    "video": "video",
    "images": "photos",
    "bag": "bag",
}
if TYPE_CHECKING:
    DatasetKind = str
else:
    DatasetKind = Literal[tuple(READERS)]


@dataclass(frozen=True)
class BagTopics:
    """Topics of a bag whose automatic choice is ambiguous."""

    colour: str | None = None
    """Topic of the colour images. By default, it is chosen by type, encoding and name."""
    depth: str | None = None
    """Topic of the depth images. By default, it is chosen by type, encoding and name."""


@dataclass(frozen=True)
class DatasetOptions:
    """The dataset of a run."""

    kind: DatasetKind = "synthetic"
    """Layout of the dataset."""
    path: Path | None = None
    """Folder of the dataset, or file of a video, bag or list of images. By default, a synthetic
    room is created beside the run folder."""
    fov_deg: Annotated[float, Range(gt=0, lt=180)] | None = None
    """Horizontal field of view in degrees of a recording without intrinsics. By default, it is
    estimated."""
    intrinsics: Literal["stated", "refine"] = "stated"
    """Intrinsics of input with depth: those stated with the recording, or refine, which replaces
    those that contradict depth and colour by the ones that agree."""
    depth_offset: Literal["auto"] | tuple[float, float] | None = None
    """Offset (x, y) in pixels of the colour images from the depth images; depth is shifted by it.
    auto estimates a constant offset from the edges of both. By default, depth is not shifted."""
    readout_ms: Literal["auto"] | Annotated[float, Range(ge=0, le=1000)] = "auto"
    """Time in milliseconds from the exposure of the first row of an image to that of the last
    (rolling shutter), for input with depth. 0 for a global shutter. auto uses readout_ms in
    intrinsics.yaml of a folder; otherwise, it is estimated from the images, and 0 if uncertain.
    Rendered images (synthetic, replica) have 0."""
    pose_convention: Literal["check", "trust", "correct"] = "check"
    """What happens if poses of the recording contradict its depth and colour, because they have
    other camera axes, are inverted, left-handed or in another unit, or have quaternions in another
    order: check stops a run with given poses, trust uses them as they are, and correct converts
    them."""
    pose_delay: Annotated[float, Range(ge=-10, le=10)] = 0.0
    """Time in seconds by which poses of the recording are late against its images, as a run or
    check-data reports it: the pose of an image is the one recorded so much later."""
    up: Literal["auto", "top", "right", "bottom", "left", "backward", "forward"] = "auto"
    """Side of the images that is up: top, right, bottom or left; backward or forward for a camera
    that looks straight down or up. auto uses the gravity of ARKit where a recording has it;
    otherwise, it compares the sides by the floor and walls of a few frames with depth, and assumes
    top without depth or with weak evidence."""
    topics: BagTopics = BagTopics()
    ignore_carrier: bool = True
    """Ignore parts of the image that keep their depth and colour while the camera moves, because
    they show what carries it: the body of a robot, a hand, the frame of a window. For input with
    depth."""
