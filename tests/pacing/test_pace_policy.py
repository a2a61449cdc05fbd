"""What the remaining time allows: steps, keyframes, and which frames are dropped."""

from __future__ import annotations

import pytest

from toolkit.slam.pacing.policy import DurationEstimate, PacePolicy

# A camera of 20 frames per second.
POLICY = PacePolicy(max_delay_s=0.4, period_s=0.05, keyframe_interval=5)


@pytest.mark.parametrize(
    ("remaining_s", "step_s", "steps"),
    [(0.035, 0.01, 3), (0.009, 0.01, 0), (-0.1, 0.01, 0), (0.0, 0.0, 0), (0.001, 0.0, 1)],
)
def test_steps_fit_into_the_remaining_time(remaining_s, step_s, steps):
    assert POLICY.steps(remaining_s, step_s) == steps


def test_frames_whose_pose_would_be_late_are_dropped():
    assert POLICY.drops(lag_s=0.35, expected_s=0.06, gap_s=0.05)
    assert not POLICY.drops(lag_s=0.35, expected_s=0.04, gap_s=0.05)


def test_the_newest_frame_is_never_dropped():
    assert not POLICY.drops(lag_s=0.049, expected_s=1.0, gap_s=0.05)
    assert POLICY.drops(lag_s=0.051, expected_s=1.0, gap_s=0.05)


def test_gaps_are_short_enough_for_tracking():
    assert POLICY.drops(lag_s=1.0, expected_s=0.05, gap_s=0.2)
    assert not POLICY.drops(lag_s=1.0, expected_s=0.05, gap_s=0.3)


def test_gaps_grow_where_tracking_takes_longer_than_they_last():
    """Otherwise the delay would grow without limit."""
    assert POLICY.drops(lag_s=1.0, expected_s=0.5, gap_s=0.9)
    assert not POLICY.drops(lag_s=1.0, expected_s=0.5, gap_s=1.1)


def test_keyframes_leave_part_of_the_delay_to_later_frames():
    assert POLICY.has_time_for_keyframe(lag_s=0.06, expected_s=0.13)
    assert not POLICY.has_time_for_keyframe(lag_s=0.08, expected_s=0.13)


def test_keyframes_of_slow_machines_may_take_longer_if_there_is_no_lag():
    assert POLICY.has_time_for_keyframe(lag_s=0.04, expected_s=0.25)
    assert not POLICY.has_time_for_keyframe(lag_s=0.06, expected_s=0.25)
    assert not POLICY.has_time_for_keyframe(lag_s=0.04, expected_s=0.27)


def test_keyframes_are_urgent_after_long_or_far_motion():
    assert not POLICY.keyframe_is_urgent(frames_since_last=19, overlap=0.9)
    assert POLICY.keyframe_is_urgent(frames_since_last=20, overlap=0.9)
    assert POLICY.keyframe_is_urgent(frames_since_last=1, overlap=0.6)


class TestDurationEstimate:
    def test_nothing_is_expected_before_the_first_measurement(self):
        assert DurationEstimate().expected_s == 0.0

    def test_equal_durations_are_expected_again(self):
        estimate = DurationEstimate()
        for _ in range(3):
            estimate.add(0.05)
        assert estimate.expected_s == pytest.approx(0.05)

    def test_varying_durations_are_expected_above_their_mean(self):
        estimate = DurationEstimate()
        for _ in range(50):
            estimate.add(0.04)
            estimate.add(0.06)
        assert 0.065 < estimate.expected_s < 0.075
        assert 0.045 < estimate.mean_s < 0.055

    def test_it_follows_a_change(self):
        estimate = DurationEstimate()
        estimate.add(0.01)
        for _ in range(40):
            estimate.add(0.1)
        assert estimate.expected_s == pytest.approx(0.1, rel=0.02)
