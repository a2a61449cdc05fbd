"""Alignment and features together: each counts by what it determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.slam.tracking.combination import combined
from toolkit.slam.tracking.feature_pose import FeaturePose
from toolkit.splatting.alignment.determinacy import UNITS

SIDEWAYS = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])


def information(*sigmas: float) -> np.ndarray:
    """Of these standard deviations, in units of 5 cm or 2 degrees."""
    return np.diag((np.array(sigmas) * UNITS) ** -2.0)


def features(T: np.ndarray, *sigmas: float, motions=None) -> FeaturePose:
    return FeaturePose(T, information(*sigmas), np.ones(50, bool), motions)


CERTAIN = (0.02,) * 6
BLIND_SIDEWAYS = (10.0, *CERTAIN[1:])


def test_features_decide_where_alignment_knows_nothing():
    found = combined(
        np.eye(4), information(*BLIND_SIDEWAYS), features(se3.exp(SIDEWAYS), *(0.1,) * 6)
    )
    np.testing.assert_allclose(found.T_map_camera[:3, 3], SIDEWAYS[:3], atol=1e-3)
    assert found.disagreement < 1.0 and not found.ambiguity()


def test_alignment_decides_where_it_is_the_more_accurate():
    found = combined(np.eye(4), information(*CERTAIN), features(se3.exp(SIDEWAYS), *(0.4,) * 6))
    assert np.linalg.norm(found.T_map_camera[:3, 3]) < 0.001


def test_features_that_contradict_count_less():
    certain = information(*CERTAIN)
    mild, strong = (
        combined(np.eye(4), certain, features(se3.exp(scale * SIDEWAYS), *CERTAIN))
        for scale in (0.05, 1.0)
    )
    assert mild.disagreement < 1.0 < strong.disagreement
    assert mild.T_map_camera[0, 3] == pytest.approx(0.5 * 0.001, rel=0.01)
    assert strong.T_map_camera[0, 3] < 0.0005


@pytest.mark.parametrize(
    ("direction", "name"),
    [(0, "to the side"), (1, "up and down"), (2, "forwards"), (3, "pitch"), (4, "yaw")],
)
def test_a_direction_that_nothing_determines_is_named(direction: int, name: str):
    sigmas = list(CERTAIN)
    sigmas[direction] = 3.0
    assert name in combined(np.eye(4), information(*sigmas), None).ambiguity()


def test_two_motions_are_named_whatever_is_determined():
    seen = features(np.eye(4), *CERTAIN, motions=(0.55, 0.4))
    found = combined(np.eye(4), information(*CERTAIN), seen)
    assert "55 % of the features" in found.ambiguity() and "40 %" in found.ambiguity()


def test_doubt_ends_where_a_direction_is_determined_clearly():
    unclear, clear = (
        combined(np.eye(4), information(sigma, *CERTAIN[1:]), None) for sigma in (0.16, 0.1)
    )
    assert not unclear.ambiguity() and unclear.ambiguity(after_ambiguous=True)
    assert not clear.ambiguity(after_ambiguous=True)


def test_features_with_a_wrong_calibration_still_end_the_doubt():
    blind = information(0.5, *CERTAIN[1:])
    beside = features(se3.exp(SIDEWAYS), *CERTAIN)
    found = combined(np.eye(4), blind, beside)
    assert combined(np.eye(4), blind, None).ambiguity()
    tilted = replace(beside, T_map_camera=se3.exp(np.array([0.02, 0, 0, 0, 0.008, 0])))
    contradicting = combined(np.eye(4), blind, tilted)
    assert contradicting.disagreement > 5.0 and not contradicting.ambiguity()
    assert np.abs(contradicting.T_map_camera[0, 3]) < np.abs(found.T_map_camera[0, 3])


def test_the_covariance_is_that_of_what_is_determined():
    sigmas = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    found = combined(np.eye(4), information(*sigmas), None)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), sigmas * UNITS, rtol=1e-3)
    unknown = combined(np.eye(4), np.zeros((6, 6)), None)
    np.testing.assert_allclose(unknown.covariance, np.eye(6))
