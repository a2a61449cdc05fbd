"""The motion model: what it expects, and what it does after a gap or a loss."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from toolkit.base.geometry import se3
from toolkit.slam.tracking.motion import ConstantVelocity

tangents = arrays(np.float64, 6, elements=st.floats(-0.4, 0.4))


def moving(start: np.ndarray, step: np.ndarray, elapsed_s: float = 0.1) -> ConstantVelocity:
    """A model that has seen one step of a screw motion."""
    motion = ConstantVelocity()
    motion.update(0.0, se3.exp(start))
    motion.update(elapsed_s, se3.exp(start) @ se3.exp(step))
    return motion


def test_nothing_seen_means_the_identity():
    assert np.array_equal(ConstantVelocity().predict(3.0), np.eye(4))
    assert ConstantVelocity().last() is None


def test_one_pose_stays_where_it_is():
    motion = ConstantVelocity()
    pose = se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0.0, -0.2]))
    motion.update(1.0, pose)
    assert np.array_equal(motion.predict(9.0), pose)


def test_poses_are_corrected_once():
    first, second, wrong = (se3.exp(np.full(6, x)) for x in (0.1, 0.2, 0.3))
    motion = ConstantVelocity()
    motion.update(0.0, wrong @ first)
    motion.correct(se3.inverse(wrong))
    motion.update(1.0, wrong @ second)
    motion.correct(se3.inverse(wrong))
    expected = second @ se3.inverse(first) @ second
    np.testing.assert_allclose(motion.predict(2.0), expected, atol=1e-12)
    restored = ConstantVelocity.from_state(motion.state())
    motion.correct(wrong)
    restored.correct(wrong)
    np.testing.assert_allclose(restored.predict(2.0), expected, atol=1e-12)
    np.testing.assert_allclose(motion.predict(2.0), expected, atol=1e-12)


@given(start=tangents, step=tangents)
def test_a_steady_screw_motion_is_predicted_exactly(start, step):
    motion = moving(start, step)
    expected = se3.exp(start) @ se3.exp(2.0 * step)
    assert np.allclose(motion.predict(0.2), expected, atol=1e-9)


@given(start=tangents, step=tangents, share=st.floats(0.1, 1.9))
def test_the_motion_scales_with_time(start, step, share):
    motion = moving(start, step)
    expected = se3.exp(start) @ se3.exp((1.0 + share) * step)
    assert np.allclose(motion.predict(0.1 + 0.1 * share), expected, atol=1e-9)


@given(world=tangents, step=tangents)
def test_the_choice_of_the_map_frame_does_not_matter(world, step):
    here = moving(np.zeros(6), step).predict(0.2)
    there = moving(world, step).predict(0.2)
    assert np.allclose(se3.exp(world) @ here, there, atol=1e-9)


def test_a_gap_does_not_fling_the_camera_away():
    step = np.array([0.05, 0.0, 0.0, 0.0, 0.1, 0.0])
    after_a_minute = moving(np.zeros(6), step).predict(60.0)
    assert np.linalg.norm(after_a_minute[:3, 3]) < 0.2


def test_forgetting_the_velocity_keeps_the_place():
    motion = moving(np.zeros(6), np.full(6, 0.1))
    place = motion.last()
    motion.forget_velocity()
    assert np.array_equal(motion.predict(0.2), place)
    motion.forget_velocity()  # nothing left to forget
    assert np.array_equal(motion.last(), place)


@pytest.mark.parametrize(
    ("interval_s", "after_s", "moved_m", "moved_on"),
    [
        (0.1, 1.0, 1.0, True),
        (0.1, 1.0, 0.1, False),
        (0.1, 0.45, 1.0, False),
        (0.03, 0.45, 1.0, True),
    ],
    ids=["after a gap", "stayed", "a few frames", "many frames"],
)
def test_after_a_gap_the_camera_may_be_elsewhere(interval_s, after_s, moved_m, moved_on):
    motion = moving(np.zeros(6), np.zeros(6), interval_s)
    motion.forget_velocity()  # a lost frame does not change how often frames come
    there = se3.exp(np.array([moved_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
    restored = ConstantVelocity.from_state(motion.state())
    for model in (motion, restored):
        assert model.has_moved_on(interval_s + after_s, there) == moved_on


def test_without_frames_there_is_no_gap():
    motion = ConstantVelocity()
    assert not motion.has_moved_on(9.0, np.eye(4))
    motion.update(0.0, se3.exp(np.ones(6)))
    assert not motion.has_moved_on(9.0, np.eye(4))


def test_poses_are_copied():
    motion = ConstantVelocity()
    pose = np.eye(4)
    motion.update(0.0, pose)
    pose[0, 3] = 5.0
    motion.last()[0, 3] = 7.0
    assert np.array_equal(motion.predict(1.0), np.eye(4))


@pytest.mark.parametrize("seen", [0, 1, 2, 5])
def test_a_restored_model_predicts_the_same_bits(seen):
    motion = ConstantVelocity()
    for i in range(seen):
        motion.update(0.1 * i, se3.exp(0.1 * i * np.arange(6.0)))
    restored = ConstantVelocity.from_state(motion.state())
    assert np.array_equal(restored.predict(1.0), motion.predict(1.0))
    restored.update(1.0, np.eye(4))
    motion.update(1.0, np.eye(4))
    assert np.array_equal(restored.predict(1.3), motion.predict(1.3))
