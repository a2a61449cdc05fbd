"""Real-time operation of SLAM: keeps up with a camera, and maps in the time that remains."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any

from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.slam.mapping.deferred import StepCounts
from toolkit.slam.mapping.keyframes import KeyframeChoice
from toolkit.slam.pacing.clock import ArrivalSchedule, Clock, MonotonicClock
from toolkit.slam.pacing.delays import FrameDelay, Outcome, PaceRecord, PaceSummary
from toolkit.slam.pacing.options import PacingOptions
from toolkit.slam.pacing.policy import DurationEstimate, PacePolicy
from toolkit.slam.result import FrameResult
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.system import Slam

_log = logging.getLogger(__name__)


class PacedSlam:
    """Feeds frames to a SLAM system at the rate of a camera.

    The pose of each frame is estimated first. Optimisation steps are deferred until the next frame
    is awaited. If time is short, keyframes are postponed; as the last resort, frames are dropped.
    Results depend on the speed of the machine and are not reproducible.

    Args:
        slam: the system, before its first frame; it must not be given frames by other means.
        fps: frames per second.
        options: defaults if absent.
        clock: that of the machine by default.

    Attributes:
        clock: times of arrival are on this clock.
    """

    def __init__(
        self,
        slam: Slam,
        fps: float,
        options: PacingOptions | None = None,
        clock: Clock | None = None,
    ) -> None:
        options = options or PacingOptions()
        self.slam = slam
        self.clock: Clock = clock or MonotonicClock()
        self._fps, self._schedule = fps, ArrivalSchedule(fps)
        choice = slam.mapper.options.keyframes
        self._policy = PacePolicy(options.max_delay_s, self._schedule.period_s, choice.interval)
        self._record = PaceRecord()
        self._tracking, self._step = DurationEstimate(), DurationEstimate()
        self._keyframes = _PostponedKeyframes(
            choice, self._policy, self.clock, self._record, self._step
        )
        self._deferred = slam.defer_work(self._keyframes)
        self._processed_at_s = -float("inf")
        self._located = False
        self._keeps_next = False
        self._dropped_in_a_row = 0

    @property
    def atlas(self) -> Atlas:
        """All submaps of the system."""
        return self.slam.atlas

    def arriving(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the frames of a recording when they arrive; steps are taken meanwhile."""
        for frame in frames:
            self._schedule.start(frame.index, self.clock.now_s())
            self.work_until(self._schedule.arrival_s(frame.index))
            yield frame

    def process_frame(
        self, frame: Frame, may_map: bool = True, arrival_s: float | None = None
    ) -> FrameResult:
        """Track a frame and map it if time permits, or drop it.

        Args:
            frame: the next frame of the sequence.
            may_map: False for a held-out view, which does not change the map.
            arrival_s: time of its arrival on `clock`; by default, frames arrive at equal intervals,
                and this function waits for their arrival.
        """
        self._schedule.start(frame.index, self.clock.now_s())
        if arrival_s is None:
            arrival_s = self._schedule.arrival_s(frame.index)
            self.work_until(arrival_s)
        if self._drops(arrival_s):
            result = self.slam.drop_frame(frame)
            self._dropped_in_a_row += 1
        else:
            self._log_dropped(f"before frame {frame.index}")
            result = self._processed(frame, may_map, arrival_s)
        delay_s = None if result.dropped else self.clock.now_s() - arrival_s
        camera_time_s = self._schedule.camera_time_s(arrival_s)
        row = FrameDelay(frame.index, camera_time_s, delay_s, outcome_of(result))
        self._record.delays.append(row)
        return result

    def work(self) -> bool:
        """Map a deferred frame or take an optimisation step; return False if none is due.

        For loops that wait for a camera. `process_frame` calls it where frames arrive at equal
        intervals.
        """
        # Rare, and up to a few frames long: they are not part of the expected time of a step.
        return self.slam.map_intermediate_frame() or self._take_step()

    def _take_step(self) -> bool:
        """Take a deferred optimisation step; return False if none is due."""
        if not self._deferred:
            return False
        start_s = self.clock.now_s()
        self.slam.take_deferred_step()
        self._step.add(self.clock.now_s() - start_s)
        return True

    def work_until(self, time_s: float) -> None:
        """Take deferred steps until a time on `clock`; sleep when none is left or none fits."""
        while self._policy.steps(time_s - self.clock.now_s(), self._step.mean_s) > 0:
            if not self.work():
                break
        self.clock.sleep_until(time_s)

    def summary(self) -> PaceSummary:
        """Delays so far, and what was skipped."""
        self._log_dropped("at the end")
        return PaceSummary(
            self._fps,
            self._policy.max_delay_s,
            tuple(self._record.delays),
            self._record.keyframes_thinned,
            self._deferred.counts,
        )

    def _drops(self, arrival_s: float) -> bool:
        """Whether to drop a frame that arrived at a time."""
        if self._keeps_next:
            return False
        lag_s = self.clock.now_s() - arrival_s
        expected_s = self._tracking.expected_s + self._keyframes.reserved_s
        return self._policy.drops(lag_s, expected_s, arrival_s - self._processed_at_s)

    def _processed(self, frame: Frame, may_map: bool, arrival_s: float) -> FrameResult:
        """Process a frame and measure how long it takes."""
        self._processed_at_s, start_s = arrival_s, self.clock.now_s()
        self._keyframes.begin(arrival_s)
        result = self.slam.process_frame(frame, may_map)
        # The next frame gives the motion model a velocity, without which tracking over dropped
        # frames would lose the camera again.
        self._keeps_next = not result.lost and not self._located
        self._located = not result.lost
        self._measure(result, start_s)
        if result.keyframe and self._keyframes.has_time_for_step:
            # Images gain more from the first step than from any later one.
            self._take_step()
        return result

    def _measure(self, result: FrameResult, start_s: float) -> None:
        """Update the expected durations with those of a frame."""
        decided_s, end_s = self._keyframes.decided_at_s, self.clock.now_s()
        if result.keyframe and decided_s is not None:
            self._tracking.add(decided_s - start_s)
            self._keyframes.duration.add(end_s - decided_s)
        elif not result.keyframe and not result.lost:
            # Neither the first keyframe nor relocalisation is typical of later frames.
            self._tracking.add(end_s - start_s)

    def _log_dropped(self, where: str) -> None:
        """Report the frames that were dropped since the last processed frame."""
        if self._dropped_in_a_row:
            _log.info("Dropped %d frames %s.", self._dropped_in_a_row, where)
        self._dropped_in_a_row = 0

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """State of the SLAM system and record of the run; deferred steps are not included."""
        arrays, values = self.slam.state()
        steps = asdict(self._deferred.counts)
        return arrays, values | {"pace": self._record.values(), "steps": steps}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`. The next frame arrives when it is given."""
        self.slam.restore(arrays, values)
        self._record.restore(values["pace"])
        self._deferred.counts = StepCounts(**values["steps"])


class _PostponedKeyframes:
    """Postpones keyframes while there is no time for them.

    Attributes:
        duration: expected time for adding a keyframe, without optimisation steps.
        decided_at_s: time of the decision about the current frame; None before it.
        has_time_for_step: whether there is time for a step of the keyframe, too.
    """

    def __init__(
        self,
        choice: KeyframeChoice,
        policy: PacePolicy,
        clock: Clock,
        record: PaceRecord,
        step: DurationEstimate,
    ) -> None:
        self.duration = DurationEstimate()
        self.decided_at_s: float | None = None
        self.has_time_for_step = False
        self._step = step
        self._choice, self._policy, self._clock = choice, policy, clock
        self._record = record
        self._arrival_s = 0.0
        self._urgent = False

    @property
    def reserved_s(self) -> float:
        """Time to reserve in the next frame for an urgent keyframe."""
        return self.duration.expected_s if self._urgent else 0.0

    def begin(self, arrival_s: float) -> None:
        """Begin the frame that arrived at a time."""
        self._arrival_s, self.decided_at_s = arrival_s, None
        self.has_time_for_step = False

    def wants(self, frames_since_last: int, overlap: float) -> bool:
        """Whether the newest frame should become a keyframe; see `KeyframeChoice`."""
        now_s = self.decided_at_s = self._clock.now_s()
        if not self._choice.wants(frames_since_last, overlap):
            self._urgent = False
            return False
        lag_s = now_s - self._arrival_s
        expected_s = self.duration.expected_s + self._step.expected_s
        self.has_time_for_step = self._policy.has_time_for_keyframe(lag_s, expected_s)
        # Frames may have been dropped before this one to make time for an urgent keyframe.
        if self._urgent or self.has_time_for_step:
            self._urgent = False
            return True
        self._urgent = self._policy.keyframe_is_urgent(frames_since_last, overlap)
        self._record.keyframes_thinned += 1
        return False


def outcome_of(result: FrameResult) -> Outcome:
    """What became of a frame."""
    if result.dropped:
        return "dropped"
    if result.lost:
        return "lost"
    if result.doubtful:
        return "doubtful"
    return "keyframe" if result.keyframe else "tracked"
