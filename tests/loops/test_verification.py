"""Verification of registrations: each requirement, its limit and its message."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.slam.loops.registration.result import RegistrationResult
from toolkit.slam.loops.verification import VerificationLimits, rejection_reason
from toolkit.splatting.alignment.data import ResidualScales

GOOD = RegistrationResult(
    np.eye(4), True, 0.9, ResidualScales(0.02, 0.005), 0.6, 0.9, np.eye(6) * 1e6, 1, 1, "test"
)
LIMITS = VerificationLimits()


def test_a_good_registration_passes():
    assert rejection_reason(GOOD, LIMITS) == ""


@pytest.mark.parametrize(
    "change",
    [
        {"overlap": LIMITS.min_overlap},
        {"inliers": LIMITS.min_inliers},
        {"class_agreement": LIMITS.min_class_agreement},
        {"class_agreement": float("nan")},
        {"residual": ResidualScales(0.02, LIMITS.max_depth_residual_m)},
        {"residual": ResidualScales(LIMITS.max_intensity_residual, 0.005)},
    ],
)
def test_limits_themselves_pass(change):
    assert rejection_reason(replace(GOOD, **change), LIMITS) == ""


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"converged": False, "reason": "went astray"}, "went astray"),
        ({"converged": False}, "registration did not converge"),
        ({"overlap": 0.1}, "only 10 % overlap"),
        ({"inliers": 0.5}, "only 50 % inliers in the overlap"),
        ({"class_agreement": 0.5}, "classes agree in only 50 % of the overlap"),
        ({"residual": ResidualScales(0.02, 0.1)}, "depth residual of 10.0 cm at 1 m"),
        ({"residual": ResidualScales(0.5, 0.005)}, "intensity residual of 0.50"),
        ({"residual": ResidualScales(0.02, float("nan"))}, "depth residual of nan cm at 1 m"),
        ({"residual": ResidualScales(float("nan"), 0.005)}, "intensity residual of nan"),
        (
            {"information": np.diag([1e6, 1e6, 1e3, 1e6, 1e6, 1e6])},
            "the overlap does not constrain the motion (information 1.0e+03)",
        ),
    ],
)
def test_rejections_name_the_requirement_and_the_value(change, message):
    assert rejection_reason(replace(GOOD, **change), LIMITS) == message
