"""Input of the SLAM system: an RGB-D frame; and the interface for recording its run times."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera


@dataclass(frozen=True)
class Frame:
    """One RGB-D image of a sequence. It does not contain the ground-truth pose, on purpose.

    The map keeps images of some frames, so that their arrays must not be changed later.

    Attributes:
        index: position in the sequence, from 0.
        timestamp_s: seconds, increasing with the index.
        rgb: [H, W, 3] float32, RGB in [0, 1].
        depth_m: [H, W] float32 z-depth in metres, 0 where missing.
        camera: intrinsics of both images.
        labels: [H, W] int32 class ids, 0 void, or None.
        inferred: [H, W] bool, where the depth was neither measured nor triangulated but follows
            from a depth prior; None if it does nowhere.
        ignored: [H, W] bool, what is neither tracked against nor mapped; its depth is missing. None
            if everything is.
        readout_s: time in seconds from the exposure of the first row to that of the last, of both
            images; 0 for a global shutter.
        readout_sigma_s: standard deviation of that time.
        fault: why its files could not be read; empty if they could. The images are black and
            without depth otherwise.

    Raises:
        ValueError: shapes or types disagree with the camera.
    """

    index: int
    timestamp_s: float
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    camera: Camera
    labels: NDArray[np.int32] | None = None
    inferred: NDArray[np.bool_] | None = None
    ignored: NDArray[np.bool_] | None = None
    readout_s: float = 0.0
    readout_sigma_s: float = 0.0
    fault: str = ""

    def __post_init__(self) -> None:
        height, width = self.camera.height, self.camera.width
        for name, image, shape, dtype in (
            ("rgb", self.rgb, (height, width, 3), np.float32),
            ("depth_m", self.depth_m, (height, width), np.float32),
            ("labels", self.labels, (height, width), np.int32),
            ("inferred", self.inferred, (height, width), np.bool_),
            ("ignored", self.ignored, (height, width), np.bool_),
        ):
            if image is None:
                continue
            if image.shape != shape or image.dtype != dtype:
                raise ValueError(
                    f"{name} must be {np.dtype(dtype)} of shape {list(shape)}, "
                    f"got {image.dtype} {list(image.shape)}"
                )


def without_pixels(frame: Frame, pixels: NDArray[np.bool_]) -> Frame:
    """Return a frame that is ignored at more pixels [H, W], without depth and labels there."""
    if not pixels.any():
        return frame
    labels = frame.labels
    return replace(
        frame,
        labels=None if labels is None else np.where(pixels, 0, labels).astype(np.int32),
        depth_m=np.where(pixels, np.float32(0.0), frame.depth_m),
        inferred=None if frame.inferred is None else frame.inferred & ~pixels,
        ignored=pixels if frame.ignored is None else frame.ignored | pixels,
    )


class FrameStamp(Protocol):
    """What is known of a frame that was not processed: its place in the sequence and its time."""

    @property
    def index(self) -> int: ...

    @property
    def timestamp_s(self) -> float: ...


class Recorder(Protocol):
    """Receives run times of the running system; does not influence it."""

    def timed(self, stage: str) -> AbstractContextManager[None]: ...  # context of one operation


class NullRecorder:
    """Recorder that discards everything; the default."""

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        yield
