"""Frusta: containment, and overlaps with known values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.frustum import (
    Frustum,
    contained_fraction,
    far_depth_m,
    in_view,
    observed_points,
)

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
tangents = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6).map(np.array)


def turned(yaw_rad: float) -> np.ndarray:
    return se3.exp(np.array([0.0, 0.0, 0.0, 0.0, yaw_rad, 0.0]))


def samples_of(frustum: Frustum, count: int = 2000) -> np.ndarray:
    """Points [count, 3] in the world, uniformly distributed in a frustum."""
    across, down, along = halton(count).T
    camera = frustum.camera
    # The cross-section grows with z^2, so z^3 is uniformly distributed.
    near, far = frustum.near_m**3, frustum.far_m**3
    z = np.cbrt(near + along * (far - near))
    x = (across * camera.width - 0.5 - camera.cx) / camera.fx * z
    y = (down * camera.height - 0.5 - camera.cy) / camera.fy * z
    return se3.transform_points(frustum.T_world_camera, np.stack([x, y, z], axis=-1))


def halton(count: int) -> np.ndarray:
    """Return points [count, 3] of the Halton sequence with bases 2, 3 and 5 in the unit cube."""
    numbers = np.arange(1, count + 1)
    columns = []
    for base in (2, 3, 5):
        rest, scale, value = numbers.copy(), 1.0 / base, np.zeros(count)
        while rest.any():
            value += scale * (rest % base)
            rest //= base
            scale /= base
        columns.append(value)
    return np.stack(columns, axis=1)


def overlap(frustum: Frustum, others: list[Frustum]) -> float:
    """Fraction of a frustum's volume inside the union of others; with errors below 1 %."""
    return contained_fraction(samples_of(frustum), others)


@given(tangents)
def test_samples_lie_inside_and_fill_the_volume(tangent):
    frustum = Frustum(CAMERA, se3.exp(tangent), 0.5, 3.0)
    samples = samples_of(frustum, 500)
    assert samples.shape == (500, 3)
    assert frustum.contains(samples).all()
    depth = se3.transform_points(se3.inverse(frustum.T_world_camera), samples)[:, 2]
    # Half of the volume is nearer than the depth whose cube is the mean of both cubes.
    assert (depth**3 < (0.5**3 + 3.0**3) / 2).mean() == pytest.approx(0.5, abs=0.02)


@given(tangents, tangents)
def test_overlap_does_not_depend_on_the_world_frame(tangent, shift):
    one, other = se3.exp(tangent), se3.exp(tangent) @ turned(0.3)
    moved = se3.exp(shift)
    here = overlap(Frustum(CAMERA, one), [Frustum(CAMERA, other)])
    there = overlap(Frustum(CAMERA, moved @ one), [Frustum(CAMERA, moved @ other)])
    assert here == pytest.approx(there, abs=0.002)


def test_overlap_is_one_with_itself_and_zero_with_the_opposite_direction():
    frustum = Frustum(CAMERA, np.eye(4))
    assert overlap(frustum, [frustum]) == 1.0
    assert overlap(frustum, [Frustum(CAMERA, turned(math.pi))]) == 0.0
    assert overlap(frustum, []) == 0.0


def test_overlap_of_frusta_of_different_depth_is_not_symmetric():
    near, far = Frustum(CAMERA, np.eye(4), 0.1, 1.0), Frustum(CAMERA, np.eye(4), 0.1, 2.0)
    assert overlap(near, [far]) == 1.0
    expected = (1.0**3 - 0.1**3) / (2.0**3 - 0.1**3)
    assert overlap(far, [near]) == pytest.approx(expected, abs=0.005)


def test_rotation_by_half_the_field_of_view_halves_the_overlap():
    # The horizontal field of view is 90 degrees and the second camera is turned by 45.
    flat, tall = Camera(50.0, 50.0, 49.5, 0.0, 100, 1), Camera(50.0, 50.0, 49.5, 9.5, 100, 20)
    frustum = Frustum(flat, np.eye(4), 1.0, 2.0)
    beside = Frustum(tall, turned(math.radians(45.0)), 0.01, 9.0)
    assert overlap(frustum, [beside]) == pytest.approx(0.5, abs=0.01)


def test_union_counts_each_point_once():
    frustum = Frustum(CAMERA, np.eye(4))
    left, right = (Frustum(CAMERA, turned(a)) for a in (-0.3, 0.3))
    both = overlap(frustum, [left, right])
    assert max(overlap(frustum, [left]), overlap(frustum, [right])) < both <= 1.0
    assert overlap(frustum, [left, left]) == overlap(frustum, [left])


def test_the_image_border_is_half_a_pixel_beyond_the_outer_pixel_centres():
    def at(x: float, y: float) -> bool:
        point = np.array([(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0])
        return bool(in_view(CAMERA, point, 0.1, 2.0))

    assert at(-0.49, 10.0) and at(63.49, 47.49)
    assert not at(-0.51, 10.0) and not at(63.51, 10.0) and not at(10.0, 47.51)


def test_non_finite_points_are_outside():
    points = np.array([[0.0, 0.0, np.nan], [np.inf, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert in_view(CAMERA, points, 0.1, 2.0).tolist() == [False, False, True]


def test_far_depths_broadcast_to_the_leading_axis():
    points = np.zeros((2, 5, 3))
    points[..., 2] = 1.5
    seen = in_view(CAMERA, points, 0.1, np.array([[1.0], [2.0]]))
    assert seen.all(axis=1).tolist() == [False, True]


def test_observed_points_lie_on_the_surface_and_their_number_is_constant():
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[:24] = 0.0
    points = observed_points(CAMERA, depth_m, 100)
    assert points.shape == observed_points(CAMERA, np.zeros_like(depth_m), 100).shape
    measured = np.isfinite(points).all(axis=1)
    assert 0.4 < measured.mean() < 0.6
    np.testing.assert_allclose(points[measured, 2], 2.0)
    assert in_view(CAMERA, points, 0.1, 2.5).sum() == measured.sum()


def test_far_depth_ignores_outliers_and_missing_depth():
    depth_m = np.r_[np.full(990, 2.0), np.full(10, 60.0), np.zeros(500)]
    assert far_depth_m(depth_m) == 2.0
    assert far_depth_m(np.zeros(5)) == 4.0


def test_contained_fraction_of_no_points_is_zero():
    assert contained_fraction(np.zeros((0, 3)), [Frustum(CAMERA, np.eye(4))]) == 0.0


@pytest.mark.parametrize(
    ("near", "far"), [(0.0, 1.0), (1.0, 1.0), (0.1, math.inf), (0.1, math.nan)]
)
def test_invalid_depth_range_raises(near, far):
    with pytest.raises(ValueError, match="near < far"):
        Frustum(CAMERA, np.eye(4), near, far)


def test_non_rigid_pose_raises():
    with pytest.raises(ValueError, match="rigid"):
        Frustum(CAMERA, 2.0 * np.eye(4))
