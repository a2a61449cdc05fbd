"""A run in progress: frames are processed, checkpoints saved, observers informed."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.printable import PrintableFormatter
from toolkit.base.stages import Stage
from toolkit.runs.checkpoint_writer import CheckpointWriter, System
from toolkit.runs.evaluation.frame_costs import FrameCostRecorder
from toolkit.runs.expected_time import ExpectedTime
from toolkit.runs.folder import RunFolder
from toolkit.runs.memory_limit import MemoryLimit
from toolkit.runs.observers import ObservedRun, Observers, Progress
from toolkit.runs.outcome import held_out
from toolkit.runs.settings import RunSettings
from toolkit.runs.stopping import StopSignals
from toolkit.slam.result import SlamResult
from toolkit.slam.system import Slam

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Session:
    """A run from its first frame to its finished map.

    Attributes:
        name: of the sequence or the camera.
        camera: intrinsics of the frames.
        settings: of the run.
        folder: the run folder.
        slam: the SLAM system.
        system: what is given the frames: `slam`, or what paces it.
        costs: measures the time and memory of frames, and the time of each stage.
        observers: are informed of the progress.
        stop: signals that end the run.
    """

    name: str
    camera: Camera
    settings: RunSettings
    folder: RunFolder
    slam: Slam
    system: System
    costs: FrameCostRecorder
    observers: Observers
    stop: StopSignals = field(default_factory=StopSignals)

    @contextmanager
    def open(self) -> Iterator[None]:
        """Append the toolkit's log to the run folder, and notify the observers of start and end."""
        with logged_to(self.folder.log):
            run = ObservedRun(self.name, self.camera, self.folder, self.slam, self.costs.recorder)
            self.observers.started(run)
            try:
                yield
            finally:
                self.observers.close()

    def process(
        self,
        frames: Iterable[Frame],
        checkpoints: CheckpointWriter,
        expected: ExpectedTime | None = None,
    ) -> None:
        """Process the remaining frames, saving checkpoints on the way.

        Args:
            frames: in order.
            checkpoints: saves them.
            expected: reports the expected duration; None if the number of frames is unknown.

        Raises:
            MemoryLimitError: nearly all memory is used; a checkpoint is saved.
            Stopped: a signal ends the run; a checkpoint is saved.
        """
        with self.costs.recorder.timed(Stage.ONLINE), self.stop.deferred():
            saved_at, new_keyframes, memory = time.monotonic(), 0, MemoryLimit()
            for frame in frames:
                new_keyframes += self._process_frame(frame, expected)
                full = memory.reached()
                if full or self.stop.number is not None:
                    checkpoints.save(self.system, frame.index + 1)
                    checkpoints.wait()
                    self.stop.check()
                    raise memory.error(self.folder.path)
                if self._checkpoint_due(saved_at, new_keyframes):
                    checkpoints.save(self.system, frame.index + 1)
                    saved_at, new_keyframes = time.monotonic(), 0

    def _process_frame(self, frame: Frame, expected: ExpectedTime | None) -> bool:
        """Process a frame; return whether it became a keyframe."""
        with self.costs.frame(frame.index):
            may_map = not held_out(frame.index, self.settings)
            result = self.system.process_frame(frame, may_map)
        if result.lost and not result.dropped:
            reason = result.tracking.reason if result.tracking else "no map exists yet"
            _log.warning("Frame %d is lost: %s.", frame.index, reason)
        elif result.doubtful:
            _log.info("Frame %d is doubtful: %s.", frame.index, result.reason)
        if expected is not None:
            expected.frame_processed(result.keyframe)
        self.observers.frame_processed(frame, result)
        return result.keyframe

    def _checkpoint_due(self, saved_at: float, new_keyframes: int) -> bool:
        options = self.settings.checkpoint
        many = new_keyframes >= options.every_keyframes and self.settings.pace == 0
        return many or time.monotonic() - saved_at > options.every_s

    def finish(self, progress: Progress) -> SlamResult:
        """Refine the map and return the final result.

        Args:
            progress: follows the steps of the refinement.
        """
        keyframes = len(self.slam.result().keyframe_indices)
        submaps = len(self.slam.atlas)
        _log.info(
            "Refining the map over %d keyframes in %s.",
            keyframes,
            "one submap" if submaps == 1 else f"{submaps} submaps",
        )
        with self.costs.recorder.timed(Stage.FINISH):
            result = self.slam.finish(lambda steps: progress(steps, len(steps), 0, "step"))
        self.observers.finished(result)
        return result

    def close_results(self) -> None:
        """After the results were written: store the submaps in metres, and only them."""
        self.slam.store_in_metres()
        self.folder.checkpoints.remove()
        self.slam.atlas.forget_checkpoints()
        self.slam.atlas.compress()


@contextmanager
def logged_to(path: Path) -> Iterator[None]:
    """Append the log of the toolkit to a file."""
    handler = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(PrintableFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logger = logging.getLogger("toolkit")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
