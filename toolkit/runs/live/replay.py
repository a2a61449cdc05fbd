"""A camera that replays a dataset in real time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import RecordedDataset
from toolkit.runs.live.camera import CapturedFrame

# Depth from files other than images has no scale of its own; this one keeps millimetres.
_DEPTH_SCALE = 1000.0
# A thread wakes up this much late without having been busy.
_TOLERANCE_S = 0.005


class ReplayCamera:
    """Shows the frames of a dataset at their own times, whether they are processed or not.

    A frame that takes longer to load than its time allows is captured when it is loaded; those
    after it keep their times.

    Args:
        dataset: what is replayed; no other thread may read it meanwhile.
        fps: frames per second, positive; by default, the timestamps of the dataset are kept.
    """

    def __init__(self, dataset: RecordedDataset, fps: float | None = None) -> None:
        self.name = dataset.name
        self.dataset: RecordedDataset | None = dataset
        own_scale = dataset.recording.container is None
        self.depth_scale = dataset.recording.depth_scale if own_scale else _DEPTH_SCALE
        self._frames, self._fps = dataset, fps
        self._stopped = threading.Event()

    def start(self) -> Camera:
        """Return the intrinsics of the dataset."""
        return self._frames.camera

    def frames(self) -> Iterator[CapturedFrame]:
        """Yield each frame when its time has come.

        Raises:
            DatasetError: a frame cannot be read.
        """
        origin_s: float | None = None
        for index, due_s in enumerate(self._times_s()):
            frame = self._frames[index]
            if origin_s is None:
                origin_s = time.monotonic()
            captured_s = origin_s + float(due_s)
            if self._stopped.wait(max(0.0, captured_s - time.monotonic())):
                return
            yield CapturedFrame(frame, max(captured_s, time.monotonic() - _TOLERANCE_S))

    def stop(self) -> None:
        """End the replay."""
        self._stopped.set()

    def _times_s(self) -> NDArray[np.float64]:
        """Times [N] of the frames since the first one."""
        if self._fps is not None:
            return np.arange(len(self._frames)) / self._fps
        times_s = self._frames.timestamps_s
        return times_s - times_s[0]
