"""One motion from many hypotheses, some of them wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from registered_room import error, motion

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.motion_average import (
    SIGMA_M,
    SIGMA_RAD,
    _inverse_right_jacobian,
    average_motion,
)

seeds = st.integers(0, 10_000)
few = settings(max_examples=15)


def hypotheses(seed: int, right: int, wrong: int, noise: float = 0.0) -> tuple:
    """T, and poses T_target_camera and T_source_camera of which so many belong together."""
    generator = np.random.default_rng(seed)
    T = motion(seed, 5.0, 120.0)
    source = [motion(seed + k, 2.0, 60.0) for k in range(1, right + wrong + 1)]
    errors = [se3.exp(noise * generator.normal(size=6)) for _ in range(right)]
    errors += [motion(seed + 50 + k, 1.0, 40.0) for k in range(wrong)]
    target = [T @ S @ E for S, E in zip(source, errors, strict=True)]
    return T, np.array(target), np.array(source)


@few
@given(seeds)
def test_a_minority_that_agrees_outvotes_those_that_do_not(seed):
    T, target, source = hypotheses(seed, right=4, wrong=6)
    found = average_motion(target, source)
    mm, deg = error(found.T_target_source, T)
    assert mm < 2.0
    assert deg < 0.2
    assert found.inliers[:4].all()
    assert not found.inliers[4:].any()


@few
@given(seeds)
def test_the_mean_is_better_than_its_parts(seed):
    T, target, source = hypotheses(seed, right=8, wrong=2, noise=0.01)
    found = average_motion(target, source)
    in_view = se3.inverse(source[0])
    wrong = error(in_view @ se3.inverse(T) @ found.T_target_source @ source[0], np.eye(4))
    assert wrong[0] < 30.0
    assert found.converged


@few
@given(seeds)
def test_the_jacobian_is_that_of_the_logarithm(seed):
    generator = np.random.default_rng(seed)
    tangent, step = 0.4 * generator.normal(size=6), 1e-6 * generator.normal(size=6)
    moved = se3.log(se3.exp(tangent) @ se3.exp(step)) - tangent
    np.testing.assert_allclose(moved, _inverse_right_jacobian(tangent) @ step, atol=1e-10)


def test_twice_the_hypotheses_are_twice_the_information():
    _, target, source = hypotheses(1, right=5, wrong=0)
    once = average_motion(target, source)
    twice = average_motion(np.tile(target, (2, 1, 1)), np.tile(source, (2, 1, 1)))
    np.testing.assert_allclose(twice.information, 2.0 * once.information, rtol=1e-6)


def test_information_is_that_of_the_sigmas():
    found = average_motion(np.eye(4)[None], np.eye(4)[None])
    expected = [1.0 / SIGMA_M**2] * 3 + [1.0 / SIGMA_RAD**2] * 3
    assert np.diag(found.information) == pytest.approx(expected)


def test_a_start_settles_a_tie():
    T, target, source = hypotheses(3, right=1, wrong=1)
    near = T @ motion(9, 0.005, 0.2)
    assert error(average_motion(target, source, start=near).T_target_source, T)[0] < 10.0
