"""Observers of a run's progress: recordings and viewers; they do not influence the run."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.folder import RunFolder
from toolkit.slam.result import FrameResult, SlamResult
from toolkit.slam.system import Slam

_log = logging.getLogger(__name__)

Item = TypeVar("Item")


class Progress(Protocol):
    """Wraps items in a progress bar."""

    def __call__(
        self, items: Iterable[Item], total: int | None, first: int, unit: str = "frame", /
    ) -> Iterable[Item]:
        """The same items.

        Args:
            items: frames, or numbers of steps.
            total: their number if it is known. first: number of those that are done.
            unit: what one of them is called.
        """
        ...


def no_progress(
    items: Iterable[Item], _total: int | None, _first: int, _unit: str = "frame", /
) -> Iterable[Item]:
    """Wrap them in nothing."""
    return items


@dataclass(frozen=True, eq=False)
class ObservedRun:
    """What an observer may read of a run, between the frames; it must not change any of it.

    Attributes:
        name: of the sequence or the camera.
        camera: intrinsics of all frames.
        folder: the run folder, which is incomplete until the run ends.
        slam: the system: map, trajectory, submaps and loops so far.
        recorder: durations of all stages so far.
    """

    name: str
    camera: Camera
    folder: RunFolder
    slam: Slam
    recorder: StageRecorder


class ProgressObserver(Protocol):
    """Follows a run. All methods are called by the thread of the run, which waits for them."""

    def started(self, run: ObservedRun) -> None:
        """The system is built; no frame has been processed since the start or a resumption."""

    def frame_processed(self, frame: Frame, result: FrameResult) -> None:
        """A frame was tracked, lost or dropped."""

    def finished(self, result: SlamResult) -> None:
        """The map is complete; its files are not written yet."""

    def close(self) -> None:
        """The run ends, complete or not; called last, and once."""


class Observers:
    """Calls several observers.

    One that fails is reported and only closed after that: a recording on a full disk must not cost
    the map.

    Args:
        observers: in the order of the calls.
    """

    def __init__(self, observers: Sequence[ProgressObserver] = ()) -> None:
        self._observers = list(observers)
        self._failed: list[ProgressObserver] = []

    def started(self, run: ObservedRun) -> None:
        """See `ProgressObserver`."""
        self._call(lambda observer: observer.started(run))

    def frame_processed(self, frame: Frame, result: FrameResult) -> None:
        """See `ProgressObserver`."""
        self._call(lambda observer: observer.frame_processed(frame, result))

    def finished(self, result: SlamResult) -> None:
        """See `ProgressObserver`."""
        self._call(lambda observer: observer.finished(result))

    def close(self) -> None:
        """See `ProgressObserver`."""
        self._observers, self._failed = self._observers + self._failed, []
        self._call(lambda observer: observer.close())
        self._observers, self._failed = [], []

    def _call(self, call: Callable[[ProgressObserver], None]) -> None:
        for observer in list(self._observers):
            try:
                call(observer)
            except Exception as error:  # noqa: BLE001 - the run continues without the observer
                self._observers.remove(observer)
                self._failed.append(observer)
                name = type(observer).__name__
                _log.warning("%s failed and is no longer called: %s", name, error)
                _log.debug("Traceback of the failure:", exc_info=True)
