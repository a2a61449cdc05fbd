"""The frames of a live camera as an iterator: the newest first, until the camera stops."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from toolkit.base.errors import CameraError, ToolkitError
from toolkit.base.frame import Frame
from toolkit.datasets.resize import ImageGrid
from toolkit.runs.live.buffer import Delivery, DroppedFrame, FrameBuffer
from toolkit.runs.live.camera import CapturedFrame, LiveCamera
from toolkit.runs.live.frame_writer import FrameWriter

_log = logging.getLogger(__name__)

# Interval at which a waiting feed looks whether it was interrupted.
_POLL_S = 0.05
# Maximum time for which a camera waits until its first frame is taken.
_FIRST_S = 5.0
# Maximum time until a camera that was stopped has returned from its driver.
_JOIN_S = 5.0


@dataclass(frozen=True)
class FeedOptions:
    """How frames are taken from a camera.

    Attributes:
        capacity: maximum number of frames that wait.
        timeout_s: time without a frame after which the camera counts as disconnected.
        max_frames: number of captured frames after which the feed ends, None without a limit.
    """

    capacity: int = 1
    timeout_s: float = 5.0
    max_frames: int | None = None


class LiveFeed:
    """Reads a camera in a background thread and yields its frames to the thread of SLAM.

    The feed ends with the camera, when it is stopped, or when the camera fails. Frames of a
    dataset keep their index; those of a camera are numbered without the dropped ones, as they are
    stored.

    Args:
        camera: started.
        options: of the feed.
        stop: is set to end the feed.
        grid: to which images are resampled, or None.
        writer: stores the frames that are yielded, or None.

    Attributes:
        failure: why the camera or the writer failed, None if neither did.
        taken: number of frames that were yielded.
        delivery: the newest one, that of the frame that was yielded last.
        idle: called while no frame waits; returns whether it had anything to do.
    """

    def __init__(
        self,
        camera: LiveCamera,
        options: FeedOptions,
        stop: threading.Event,
        grid: ImageGrid | None = None,
        writer: FrameWriter | None = None,
    ) -> None:
        self._camera, self._options, self._stop = camera, options, stop
        self._grid, self._writer = grid, writer
        self._buffer = FrameBuffer(options.capacity)
        self.taken = 0
        self._reader = threading.Thread(target=self._read, name="camera", daemon=True)
        self.failure: ToolkitError | None = None
        self.delivery = Delivery(None, ())
        self.idle: Callable[[], bool] = lambda: False

    def __iter__(self) -> Iterator[Frame]:
        self._reader.start()
        try:
            while (captured := self._next()) is not None:
                frame = self._prepared(captured)
                self.delivery = replace(self.delivery, captured=replace(captured, frame=frame))
                yield frame
        except ToolkitError as error:
            self.failure = error
        finally:
            self._camera.stop()
            # The evaluation may read the files that a replay reads.
            self._reader.join(_JOIN_S)

    @property
    def left(self) -> tuple[DroppedFrame, ...]:
        """Frames at the end that were dropped after the last one that was yielded."""
        return self.delivery.dropped if self.delivery.captured is None else ()

    def _next(self) -> CapturedFrame | None:
        """The next frame, None at the end."""
        deadline_s = time.monotonic() + self._options.timeout_s
        while not self._stop.is_set():
            if not self._buffer.has_frame and self.idle():
                delivery = None
            else:
                delivery = self._buffer.take(_POLL_S)
            if delivery is not None:
                self.delivery = delivery
                return delivery.captured
            if time.monotonic() > deadline_s:
                raise CameraError(
                    f"no frame from {self._camera.name} for {self._options.timeout_s:g} s; check "
                    "the cable and that no other program uses the camera"
                )
        return None

    def _prepared(self, captured: CapturedFrame) -> Frame:
        """Number, store and resample a frame."""
        frame = captured.frame
        if self._camera.dataset is None:
            frame = replace(frame, index=self.taken)
        self.taken += 1
        if self._writer is not None:
            self._writer.write(frame)
        if self._grid is None:
            return frame
        return replace(
            frame,
            rgb=self._grid.colour(frame.rgb),
            depth_m=self._grid.depth(frame.depth_m),
            labels=None if frame.labels is None else self._grid.nearest(frame.labels),
            camera=self._grid.camera,
        )

    def _read(self) -> None:
        """Fill the buffer; runs in a thread of its own."""
        limit = self._options.max_frames
        try:
            for count, captured in enumerate(self._camera.frames()):
                self._buffer.put(captured)
                if count == 0:
                    # The frames before the first one that is processed would have no pose.
                    self._buffer.wait_until_taken(_FIRST_S)
                if self._stop.is_set() or (limit and captured.frame.index + 1 >= limit):
                    break
        except ToolkitError as error:
            self._buffer.end(error)
        except Exception as error:  # noqa: BLE001 - whatever a driver raises, the map is saved
            _log.debug("Traceback of the error:", exc_info=True)
            text = " ".join(str(error).split()) or repr(error)
            self._buffer.end(CameraError(f"{self._camera.name} failed: {text}"))
        else:
            self._buffer.end()
