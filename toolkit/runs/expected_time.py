"""Estimates the duration of a run from its first frames, and proposes smaller images."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.stages import Stage
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.settings import RunSettings
from toolkit.slam.mapping.final_optimisation import step_count

_log = logging.getLogger(__name__)

# The first frame starts the map and loads libraries, so it is not representative. With the default
# settings, 20 more frames contain at least four keyframes.
_MIN_FRAMES = 20
_MIN_KEYFRAMES = 2

# The motion of the camera: frames that are not representative, and those that are timed.
_FIRST_MOTION_FRAMES, _MOTION_FRAMES = 10, 30

# Longer runs of larger images are followed by a proposal.
_LONG_S = 300.0
_LARGE_PIXELS = 480 * 360

# Stages of an optimisation step of the map; the first one is timed once per step.
_STEP_STAGES = (
    Stage.MAP_FORWARD,
    Stage.MAP_LOSS,
    Stage.MAP_SEMANTIC_LOSS,
    Stage.MAP_BACKWARD,
    Stage.MAP_UPDATE,
)


class ExpectedTime:
    """Logs the expected duration of a run once, after its first frames.

    The log is written after at least 20 frames and two keyframes beside the first frame.

    Args:
        settings: of the run.
        camera: intrinsics of the processed images.
        frames: indices of the frames to process; a resumed run does not start at 0.
        recorder: has the times of the optimisation steps.
        clock: returns a time in seconds.
    """

    def __init__(
        self,
        settings: RunSettings,
        camera: Camera,
        frames: range,
        recorder: StageRecorder,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._settings, self._camera, self._frames = settings, camera, frames
        self._recorder, self._clock = recorder, clock
        self._begin_s = clock()
        self._first_s = 0.0
        self._processed = self._keyframes = 0
        self._done = False

    def frame_processed(self, keyframe: bool) -> None:
        """Count a frame; write the log as soon as the estimate is meaningful.

        Args:
            keyframe: whether the frame became a keyframe.
        """
        if self._done:
            return
        if self._processed == 0:
            self._first_s = self._clock() - self._begin_s
        else:
            self._keyframes += keyframe
        self._processed += 1
        if self._processed > _MIN_FRAMES and self._keyframes >= _MIN_KEYFRAMES:
            self._done = True
            if self._processed < len(self._frames):
                _log.info("%s", self._message())

    def _message(self) -> str:
        others = self._processed - 1
        frame_s = (self._clock() - self._begin_s - self._first_s) / others
        count, resumed = len(self._frames), self._frames.start > 0
        # The refinement includes the keyframes before a resumed run.
        refined_s = self._refinement_s(self._keyframes * self._frames.stop // others)
        total_s = self._first_s + frame_s * (count - 1) + refined_s
        text = (
            f"About {_duration(total_s)} expected for "
            f"{'the remaining ' if resumed else ''}{count:,} frames "
            f"({total_s / count:.2g} s per frame, refinement included)"
        )
        # A resumed run must keep its settings.
        large = self._camera.width * self._camera.height > _LARGE_PIXELS
        # Frames that arrive at camera rate take as long at any size.
        proposes = self._settings.image_size is None and self._settings.pace == 0 and not resumed
        if proposes and large and total_s > _LONG_S:
            width, height = self._camera.width // 2, self._camera.height // 2
            text += f"; --image-size {width} {height} would take about a quarter of it"
        return f"{text}."

    def _refinement_s(self, keyframes: int) -> float:
        """Expected time of the final refinement of some keyframes."""
        mapping = self._settings.mapping
        steps = step_count(mapping, keyframes)
        if mapping.consensus.use and self._recorder.durations_ms.get(Stage.LABELLING):
            # Each vote on the labels takes about as long as a step.
            steps += (mapping.consensus.rounds + 1) * keyframes
        taken = len(self._recorder.durations_ms.get(_STEP_STAGES[0], ()))
        total_ms = self._recorder.total_ms(*_STEP_STAGES)
        return 0.0 if total_ms is None or not taken else steps * total_ms / (1e3 * taken)


def with_expected_motion_time(
    frames: Iterable[Frame],
    total: int,
    passes: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Frame]:
    """Iterate over frames, and log how long their motion will take after some of them.

    Args:
        frames: whose motion is estimated while they are iterated over.
        total: their number.
        passes: maximum number of times that they are iterated over.
        clock: returns a time in seconds.
    """
    begin_s = 0.0
    for number, frame in enumerate(frames):
        if number == _FIRST_MOTION_FRAMES:
            begin_s = clock()
        if number == _FIRST_MOTION_FRAMES + _MOTION_FRAMES and total > 2 * number:
            frame_s = (clock() - begin_s) / _MOTION_FRAMES
            text = f" for each of up to {passes} passes, which find the focal length"
            _log.info(
                "About %s expected for the motion of %s frames%s; mapping follows.",
                _duration(frame_s * total),
                f"{total:,}",
                text if passes > 1 else "",
            )
        yield frame


def _duration(seconds: float) -> str:
    if seconds < 90.0:
        return f"{max(10, 10 * round(seconds / 10)):d} seconds"
    if seconds < 90.0 * 60.0:
        return f"{round(seconds / 60):d} minutes"
    return f"{seconds / 3600:.1f} hours"
