"""How sure the frames of a run are."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.base.pose_graph.noise import OdometryNoise, pixel_covariance
from toolkit.slam.loops.closing.uncertainty import PathPose, frame_covariances, measured_links

NOISE = OdometryNoise()
SURE = np.zeros((6, 6))
PIXEL = np.diag([4e-4] * 3 + [1e-4] * 3)


def walk(count, step_m=0.1):
    return [se3.exp(np.array([k * step_m, 0, 0, 0, 0, 0])) for k in range(count)]


def keyframes(poses, pixel=PIXEL, submap=0):
    return [PathPose(submap, T, True, pixel) for T in poses]


def covariances(path, anchors=(SURE,)):
    return frame_covariances(anchors, path, NOISE)


def spread(found):
    return np.trace(found, axis1=1, axis2=2)


def test_a_frame_is_the_less_sure_the_farther_its_anchor():
    found = covariances(keyframes(walk(20)))
    assert (np.diff(spread(found)) > 0).all()
    np.testing.assert_allclose(found, np.swapaxes(found, 1, 2), atol=1e-15)


def test_drift_and_frame_follow_from_the_residuals():
    (found,) = covariances([PathPose(0, walk(2)[1], False, PIXEL)])
    expected = (0.1 * NOISE.drift_ratio**2 + NOISE.frame_ratio**2) * PIXEL
    np.testing.assert_allclose(found, expected)
    larger = covariances([PathPose(0, walk(2)[1], False, 9 * PIXEL)])[0]
    np.testing.assert_allclose(larger, 9 * expected)


def test_a_camera_that_returns_is_as_sure_as_before():
    there = walk(10)
    found = covariances(keyframes([*there, *there[::-1]]))
    # Both have moved by the same step since the frame before.
    np.testing.assert_allclose(found[18], found[1], atol=1e-12)
    assert spread(found)[9] > 1.2 * spread(found)[1]


def test_a_fast_frame_is_less_sure():
    slow, fast = walk(9, 0.05), walk(9, 0.05)[::4]
    at_slow, at_fast = (covariances(keyframes(poses))[-1] for poses in (slow, fast))
    expected = NOISE.frame_ratio**2 * (0.2 - 0.05) / NOISE.moved * PIXEL
    np.testing.assert_allclose(at_fast - at_slow, expected, rtol=0.01, atol=2e-6)


def test_a_view_in_another_direction_does_not_make_it_sure():
    """The same position, turned around: no surface is seen again."""
    there = walk(10)
    around = se3.exp(np.array([0, 0, 0, 0, 3.0, 0]))
    back = [T @ around for T in there[::-1]]
    found = spread(covariances(keyframes([*there, *back])))
    # After the turn, each frame has moved by the same step as before it.
    assert found[19] > found[11] > found[9]


def test_views_far_apart_are_connected_by_the_chain_between_them():
    """Over a jump of the path, the newest keyframe is all there is."""
    poses = [*walk(3), *[walk(2, 5.0)[1] @ T for T in walk(3)]]
    found = spread(covariances(keyframes(poses)))
    assert found[4] > 2 * found[2] and found[5] > found[4]


def test_each_submap_begins_anew_from_its_anchor():
    anchor = np.diag([1e-4] * 3 + [1e-6] * 3)
    path = [*keyframes(walk(9)), *keyframes([np.eye(4)], submap=1)]
    found = covariances(path, (SURE, anchor))
    np.testing.assert_allclose(found[-1] - anchor, found[0], atol=1e-12)


def test_a_turned_anchor_moves_what_is_far_from_it():
    anchor = np.diag([0.0] * 3 + [1e-4] * 3)
    far = PathPose(0, walk(2, 3.0)[1], False, PIXEL)
    difference = covariances([far], (anchor,))[0] - covariances([far])[0]
    # A hundredth of a radian at 3 m, across the line of sight.
    np.testing.assert_allclose(difference[1, 1], 1e-4 * 9.0, rtol=1e-6)


def test_without_measurements_the_constants_count():
    (found,) = covariances([PathPose(0, walk(2)[1], False, SURE)])
    np.testing.assert_allclose(found, NOISE.covariance(1e9 * np.eye(6), 0.1, 0.0))


def test_an_odometry_edge_is_as_sure_as_the_keyframe_it_ends_at():
    poses = walk(10)
    path = [*keyframes(poses), *keyframes([np.eye(4)], submap=1)]
    link = PoseEdge(0, 1, poses[9], np.eye(6))
    (measured,) = measured_links([link], path, NOISE)
    last = covariances(path, (SURE, SURE))[9]
    assert (measured.first, measured.second) == (0, 1)
    step = NOISE.of_frame(PIXEL, 0.1) - NOISE.of_frame(PIXEL, 0.0)
    found = np.linalg.inv(measured.information)
    np.testing.assert_allclose(found, last - step, rtol=1e-6, atol=1e-12)


def test_an_edge_without_frames_is_unchanged():
    link = PoseEdge(0, 1, walk(2)[1], np.eye(6))
    assert measured_links([link], keyframes(walk(3)), NOISE) == [link]


def test_nothing_tracked():
    assert covariances([]).shape == (0, 6, 6)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_the_number_of_pixels_does_not_matter(scale):
    H = np.diag([1e8, 2e8, 3e8, 4e8, 5e8, 6e8])
    few, many = pixel_covariance(H, 1000, 1.0), pixel_covariance(scale * H, int(1000 * scale), 1.0)
    np.testing.assert_allclose(few, many)
    np.testing.assert_allclose(few, 1000 * np.linalg.inv(H), rtol=1e-2)


def test_an_undetermined_direction_is_bounded():
    H = np.diag([0.0, 1e8, 1e8, 1e8, 1e8, 1e8])
    found = pixel_covariance(H, 1000, 1.0)
    assert found[0, 0] == pytest.approx(1.0) and found[1, 1] < 1e-4
    assert not pixel_covariance(np.zeros((6, 6)), 1000, 1.0).any()
