"""Options of live cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import PositiveFloat, Range


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """A live camera and what is kept of its frames."""

    camera: Literal["realsense", "replay"] = "realsense"
    """Source of the frames: a RealSense depth camera, or a dataset at the rate of its timestamps
    (replay)."""
    fps: Annotated[float, Range(gt=0, le=1000)] | None = None
    """Frames per second of the camera. By default, those of --pace or of the timestamps of a
    dataset, and 30 of a RealSense camera."""
    serial: str | None = None
    """Serial number of the RealSense camera. By default, the first one that is connected."""
    timeout_s: PositiveFloat = 5.0
    """Seconds without a frame after which a RealSense camera counts as disconnected."""
    save_frames: bool = False
    """Keep the processed frames in the folder recording/ of the run, as a dataset of kind folder
    with which the run can be repeated. Otherwise, the frames of a camera are removed after the
    evaluation."""
