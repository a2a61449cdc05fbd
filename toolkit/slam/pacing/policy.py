"""Decisions of real-time operation: steps, keyframes and frames that the remaining time allows."""

from __future__ import annotations

from dataclasses import dataclass

# Weight of the newest duration in an estimate.
_WEIGHT = 0.2
# Number of mean deviations above the mean that is expected: the delay is a bound, not a mean.
_DEVIATIONS = 2.0
# Fraction of the maximum delay up to which keyframes may add to a lag. The rest is for keyframes
# that take longer than expected: a lag allows no more keyframes per second than none does.
_KEYFRAME_SHARE = 0.5
# The same for a frame that is processed when it arrives: slow machines need keyframes, too.
_PROMPT_KEYFRAME_SHARE = 0.75
# Overlap with the last keyframe below which a keyframe is urgent, and number of keyframe intervals
# after which it is: tracking fails where most of the view is not mapped.
_URGENT_OVERLAP = 0.65
_URGENT_INTERVALS = 4
# Maximum time without a processed frame. Motions over longer gaps are too large for tracking.
_MAX_GAP_S = 0.25
# The gap may be longer if a single frame takes that long, or the delay would grow without limit.
_MAX_GAP_FRAMES = 2.0


class DurationEstimate:
    """Expected duration of a repeated operation."""

    def __init__(self) -> None:
        self._mean_s: float | None = None
        self._deviation_s = 0.0

    @property
    def mean_s(self) -> float:
        """Running mean of the durations; 0 before the first one."""
        return 0.0 if self._mean_s is None else self._mean_s

    @property
    def expected_s(self) -> float:
        """Running mean of the durations plus two mean deviations; 0 before the first one."""
        return self.mean_s + _DEVIATIONS * self._deviation_s

    def add(self, duration_s: float) -> None:
        """Add a measured duration."""
        if self._mean_s is None:
            self._mean_s = duration_s
            return
        error_s = duration_s - self._mean_s
        self._mean_s += _WEIGHT * error_s
        self._deviation_s += _WEIGHT * (abs(error_s) - self._deviation_s)


@dataclass(frozen=True)
class PacePolicy:
    """Turns the remaining time into decisions.

    Attributes:
        max_delay_s: maximum time from the arrival of a frame to its pose.
        period_s: time between two frames.
        keyframe_interval: maximum number of frames between keyframes without time pressure.
    """

    max_delay_s: float
    period_s: float
    keyframe_interval: int

    def steps(self, remaining_s: float, step_s: float) -> int:
        """Number of optimisation steps that fit into the remaining time.

        Args:
            remaining_s: time until the next frame arrives; negative if it has arrived.
            step_s: mean duration of a step; 0 if it is unknown, which allows one step.
        """
        if remaining_s <= 0:
            return 0
        return int(remaining_s / step_s) if step_s > 0 else 1

    def drops(self, lag_s: float, expected_s: float, gap_s: float) -> bool:
        """Whether a frame is dropped.

        The newest frame is never dropped, so that processing continues however slow it is.

        Args:
            lag_s: time since the frame's arrival.
            expected_s: expected time until its pose is known.
            gap_s: time from the arrival of the last processed frame to that of this one.
        """
        newer_has_arrived = lag_s >= self.period_s
        too_late = lag_s + expected_s > self.max_delay_s
        max_gap_s = max(_MAX_GAP_S, _MAX_GAP_FRAMES * expected_s)
        return newer_has_arrived and too_late and gap_s < max_gap_s

    def has_time_for_keyframe(self, lag_s: float, expected_s: float) -> bool:
        """Whether a tracked frame may become a keyframe.

        Args:
            lag_s: time since the frame's arrival.
            expected_s: expected time for adding a keyframe.
        """
        prompt = lag_s < self.period_s
        share = _PROMPT_KEYFRAME_SHARE if prompt else _KEYFRAME_SHARE
        return lag_s + expected_s <= share * self.max_delay_s

    def keyframe_is_urgent(self, frames_since_last: int, overlap: float) -> bool:
        """Whether tracking may fail without a new keyframe.

        Args:
            frames_since_last: number of frames since the last keyframe.
            overlap: fraction of the last keyframe's points that the newest frame sees.
        """
        too_old = frames_since_last >= _URGENT_INTERVALS * self.keyframe_interval
        return too_old or overlap < _URGENT_OVERLAP
