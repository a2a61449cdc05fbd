"""Results and their inversion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from registered_room import Scene, motion

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.result import RegistrationResult, failed, register_pair

seeds = st.integers(0, 10_000)
few = settings(max_examples=15)


def some_result(seed: int) -> RegistrationResult:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    T = motion(seed, 2.0, 70.0)
    return replace(failed("test", ""), T_target_source=T, information=root @ root.T)


@few
@given(seeds)
def test_an_inverted_result_weighs_the_same_error_alike(seed):
    result = some_result(seed)
    x = 0.01 * np.random.default_rng(seed + 1).normal(size=6)
    inverted = result.inverted()
    wrong = result.T_target_source @ se3.exp(x)
    y = se3.log(se3.inverse(inverted.T_target_source) @ se3.inverse(wrong))
    assert y @ inverted.information @ y == pytest.approx(x @ result.information @ x, rel=1e-6)


@few
@given(seeds)
def test_inverting_twice_changes_nothing(seed):
    result = some_result(seed)
    twice = result.inverted().inverted()
    np.testing.assert_allclose(twice.T_target_source, result.T_target_source, atol=1e-12)
    np.testing.assert_allclose(twice.information, result.information, rtol=1e-9, atol=1e-9)


class Noting:
    """A registrar that notes what it was asked and answers with a fixed motion."""

    def __init__(self, T_target_source: np.ndarray) -> None:
        self.answer, self.asked = T_target_source, ()

    def register(self, target, source, T_target_source=None) -> RegistrationResult:
        self.asked = (target, source, T_target_source)
        return replace(failed("noting", ""), T_target_source=self.answer)


def test_the_submap_with_more_keyframes_is_the_target(room: Scene):
    big, small = room.target, room.source
    assert len(big.keyframes) > len(small.keyframes)
    start, answer = motion(1, 0.3, 20.0), motion(2, 0.5, 10.0)
    registrar = Noting(answer)
    result = register_pair(registrar, big, small, start)
    assert registrar.asked == (big, small, start)
    np.testing.assert_array_equal(result.T_target_source, answer)
    result = register_pair(registrar, small, big, start)
    assert registrar.asked[:2] == (big, small)
    np.testing.assert_allclose(registrar.asked[2], se3.inverse(start))
    np.testing.assert_allclose(result.T_target_source, se3.inverse(answer))
