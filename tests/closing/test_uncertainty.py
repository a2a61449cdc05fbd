"""How sure the frames of a run are."""

from __future__ import annotations

import numpy as np

from toolkit.closing.uncertainty import frame_covariances
from toolkit.geometry import se3
from toolkit.pose_graph.noise import OdometryNoise

NOISE = OdometryNoise()
SURE = np.zeros((6, 6))


def walk(count, step_m=0.1):
    return [se3.exp(np.array([k * step_m, 0, 0, 0, 0, 0])) for k in range(count)]


def test_a_frame_is_the_less_sure_the_farther_its_anchor():
    found = frame_covariances([SURE], [0] * 20, walk(20), NOISE)
    spread = np.trace(found, axis1=1, axis2=2)
    assert (np.diff(spread) > 0).all()
    # After 1.9 m in a straight line.
    assert found[-1][0, 0] > NOISE.options.per_metre_m**2 * 1.9
    np.testing.assert_allclose(found, np.swapaxes(found, 1, 2))


def test_the_way_counts_and_not_the_distance():
    there = walk(10)
    back = [*there, *there[::-1]]
    found = frame_covariances([SURE], [0] * 20, back, NOISE)
    assert np.trace(found[-1]) > np.trace(found[9])


def test_each_submap_begins_anew_from_its_anchor():
    anchor = np.diag([1e-4] * 3 + [1e-6] * 3)
    found = frame_covariances([SURE, anchor], [0] * 9 + [1], [*walk(9), np.eye(4)], NOISE)
    np.testing.assert_allclose(found[-1] - anchor, found[0], atol=1e-12)


def test_a_turned_anchor_moves_what_is_far_from_it():
    anchor = np.diag([0.0] * 3 + [1e-4] * 3)
    _, far = frame_covariances([anchor], [0, 0], [np.eye(4), walk(2, 3.0)[1]], NOISE)
    odometry = NOISE.covariance(1e9 * np.eye(6), 3.0, 0.0)
    # A hundredth of a radian at 3 m, across the line of sight.
    np.testing.assert_allclose((far - odometry)[1, 1], 1e-4 * 9.0, rtol=1e-6)


def test_nothing_tracked():
    assert frame_covariances([SURE], [], [], NOISE).shape == (0, 6, 6)
