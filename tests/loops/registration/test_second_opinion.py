"""Two registrars must not contradict each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.factory import build_registrar
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import failed
from toolkit.slam.loops.registration.sgr import SecondOpinion
from toolkit.slam.loops.registration.views import ViewRenderer


class Says:
    """Always the same answer."""

    def __init__(self, step=(0, 0, 0, 0, 0, 0), converged=True, method="other"):
        self.step, self.converged, self.method, self.asked = step, converged, method, []

    def register(self, target, source, T_target_source=None):
        self.asked.append(T_target_source)
        T = se3.exp(np.array(self.step, float))
        reason = "" if self.converged else "nothing found"
        return replace(
            failed(self.method, reason, T), converged=self.converged, inliers=0.9, renders=3
        )


def verdict(first, second, start=None):
    return SecondOpinion(first, second).register(None, None, start)


def test_if_both_agree_the_first_result_is_returned():
    first, second = Says((1, 0, 0, 0, 0, 0), method="sgr"), Says((1.05, 0, 0, 0, 0.01, 0))
    result = verdict(first, second, np.eye(4))
    assert result.converged
    assert result.T_target_source[0, 3] == 1.0
    assert result.renders == 6
    # It begins from nothing, or it would only confirm the start.
    assert second.asked == [None]


@pytest.mark.parametrize("step", [(0, 0, 0.3, 0, 0, 0), (0, 0, 0, 0.2, 0, 0)])
def test_if_they_differ_the_result_is_rejected_with_a_reason(step):
    result = verdict(Says(method="sgr"), Says(step, method="clouds"))
    assert not result.converged
    assert result.reason.startswith("clouds differs by")


def test_a_second_registration_that_fails_changes_nothing():
    assert verdict(Says(), Says((5, 0, 0, 0, 0, 0), converged=False)).converged


def test_a_rejected_result_needs_no_second_registration():
    second = Says()
    assert not verdict(Says(converged=False), second).converged
    assert second.asked == []


def test_a_run_can_ask_for_one():
    settings = RegistrationOptions(kind="two-way", second_opinion=True)
    registrar = build_registrar(settings, 0, ViewRenderer())
    assert isinstance(registrar, SecondOpinion)
    settings = RegistrationOptions(kind="clouds", second_opinion=True)
    assert not isinstance(build_registrar(settings, 0, ViewRenderer()), SecondOpinion)
