"""The interface of live cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import RecordedDataset


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """A frame of a live camera.

    Attributes:
        frame: images, intrinsics and the camera's own time; its index counts all frames since the
            start, also those that are dropped later.
        captured_s: time of capture on the clock of `time.monotonic`.
    """

    frame: Frame
    captured_s: float


class LiveCamera(Protocol):
    """A source of frames in real time. One thread calls `frames`, another one the other methods.

    Attributes:
        name: short name for reports.
        depth_scale: values per metre with which its depth can be stored in 16 bits.
        dataset: what a replay shows, whose frame i has index i; None for a camera.
    """

    name: str
    depth_scale: float
    dataset: RecordedDataset | None

    def start(self) -> Camera:
        """Open the camera and return the intrinsics of its frames.

        Raises:
            ToolkitError: the camera is missing or busy.
        """

    def frames(self) -> Iterator[CapturedFrame]:
        """Yield the frames when they are captured, in order of time, until the camera is stopped.

        Raises:
            ToolkitError: the camera was disconnected, or its driver reports an error.
        """

    def stop(self) -> None:
        """Close the camera; `frames` ends."""
