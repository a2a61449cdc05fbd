"""Options of sequences without depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from toolkit.base.options import NonNegativeInt, PositiveFloat

MarkerDictionary = Literal[
    "apriltag-36h11",
    "apriltag-25h9",
    "apriltag-16h5",
    "aruco-4x4",
    "aruco-5x5",
    "aruco-6x6",
    "aruco-7x7",
    "aruco-original",
]


@dataclass(frozen=True)
class ScaleOptions:
    """A known length that makes the unit of a map without depth the metre; at most one of them."""

    marker_m: PositiveFloat | None = None
    """Side length of the printed markers that are seen, in metres, without the white margin."""
    marker_dictionary: MarkerDictionary = "apriltag-36h11"
    """Kind of the markers: AprilTag or ArUco."""
    distance_m: PositiveFloat | None = None
    """Distance between the positions of the camera at two frames, in metres."""
    distance_frames: tuple[NonNegativeInt, NonNegativeInt] | None = None
    """Indices of the two frames of the known distance."""
    camera_height_m: PositiveFloat | None = None
    """Mean height of the camera above the floor, in metres. The floor must be visible, and the
    camera held in one way (--dataset.up)."""
