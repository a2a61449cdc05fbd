"""A bounded buffer between the thread of a camera and SLAM: it keeps the newest frames."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from toolkit.runs.live.camera import CapturedFrame


@dataclass(frozen=True)
class DroppedFrame:
    """A frame that the buffer had no room for.

    Attributes:
        index: of the frame, as the camera counts.
        timestamp_s: the camera's time. captured_s: as in `CapturedFrame`.
    """

    index: int
    timestamp_s: float
    captured_s: float


@dataclass(frozen=True, eq=False)
class Delivery:
    """What the buffer hands over at once.

    Attributes:
        captured: the oldest frame that it still had; None if only dropped frames remain.
        dropped: the frames before it that were dropped since the delivery before.
    """

    captured: CapturedFrame | None
    dropped: tuple[DroppedFrame, ...]


class FrameBuffer:
    """Hands frames from one thread to another; if it is full, the oldest frame is dropped.

    Args:
        capacity: maximum number of frames, >= 1.
    """

    def __init__(self, capacity: int = 1) -> None:
        self._capacity = capacity
        self._frames: deque[CapturedFrame] = deque()
        self._dropped: list[DroppedFrame] = []
        self._changed = threading.Condition()
        self._ended = False
        self._error: Exception | None = None

    def put(self, captured: CapturedFrame) -> None:
        """Add the newest frame; never waits."""
        with self._changed:
            if len(self._frames) == self._capacity:
                old = self._frames.popleft()
                frame = old.frame
                self._dropped.append(DroppedFrame(frame.index, frame.timestamp_s, old.captured_s))
            self._frames.append(captured)
            self._changed.notify_all()

    def end(self, error: Exception | None = None) -> None:
        """No frames follow, because the camera was stopped or because of an error."""
        with self._changed:
            self._ended, self._error = True, error
            self._changed.notify_all()

    def wait_until_taken(self, timeout_s: float) -> None:
        """Wait until no frame is left to take."""
        with self._changed:
            self._changed.wait_for(lambda: not self._frames, timeout_s)

    @property
    def has_frame(self) -> bool:
        """Whether `take` would return at once."""
        with self._changed:
            return bool(self._frames) or self._ended

    def take(self, timeout_s: float) -> Delivery | None:
        """Take the oldest frame; wait for one if there is none.

        Returns:
            None if no frame came in this time. Without a frame, the end has been reached.

        Raises:
            Exception: the error of the camera, after the last frame before it.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._ended, timeout_s)
            if not self._frames and not self._ended:
                return None
            if not self._frames and self._error is not None:
                raise self._error
            dropped, self._dropped = tuple(self._dropped), []
            captured = self._frames.popleft() if self._frames else None
            self._changed.notify_all()
            return Delivery(captured, dropped)
