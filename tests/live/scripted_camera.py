"""A camera whose frames, pauses and failures a test determines."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.runs.live.camera import CapturedFrame


class ScriptedCamera:
    """Shows some frames; then it ends, fails or sends nothing more.

    Args:
        frames: what it shows.
        error: raised after the last frame.
        stalls: send nothing after the last frame until it is stopped.
        taken: released by a test for each frame but the first; None shows all at once.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        error: Exception | None = None,
        stalls: bool = False,
        taken: threading.Semaphore | None = None,
    ) -> None:
        self.name = "scripted"
        self.depth_scale = 5000.0
        self.dataset: RecordedDataset | None = None
        self._frames, self._error, self._stalls, self._taken = frames, error, stalls, taken
        self.stopped = threading.Event()

    def start(self) -> Camera:
        return self._frames[0].camera

    def frames(self) -> Iterator[CapturedFrame]:
        for number, frame in enumerate(self._frames):
            if number and self._taken is not None:
                self._taken.acquire()
            yield CapturedFrame(frame, time.monotonic())
        if self._taken is not None:
            self._taken.acquire()
        if self._error is not None:
            raise self._error
        if self._stalls:
            self.stopped.wait(30.0)

    def stop(self) -> None:
        self.stopped.set()


def room_frames(count: int) -> list[Frame]:
    """Frames of a small room."""
    return list(tiny_room(count, 64, 48)[0])
