"""Pixels of cameras with other intrinsics, and derivatives of residuals."""

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.datasets.agreement.lens import derivatives, distorted, undistorted

VALUES = np.array([0.08, 0.03, -0.02, -0.15])


def test_undistortion_is_the_inverse():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 50))
    np.testing.assert_allclose(undistorted(distorted(points, VALUES), VALUES), points, atol=2e-3)
    np.testing.assert_array_equal(distorted(points, np.zeros(4)), points)


@pytest.mark.parametrize("values", [np.zeros(4), VALUES])
def test_derivatives_are_those_of_the_residual(values):
    """Of a function that is linear in pixel and depth, for a pose and intrinsics that change."""
    generator = np.random.default_rng(1)
    rays, depths = generator.uniform(-0.3, 0.3, (2, 20)), generator.uniform(1.0, 3.0, 20)
    pixels, slope = distorted(rays, values), generator.normal(size=(2, 20))
    T = se3.exp(np.array([0.1, -0.05, 0.02, 0.05, -0.1, 0.08]))

    def residual(unknowns):
        own = values + unknowns[8:]
        # The fixed points of the first image move with the intrinsics.
        ray = rays
        for _ in range(200):
            ray = ray + pixels - distorted(ray, own)
        points = np.concatenate([ray * depths, depths[None]])
        moved = se3.transform_points(se3.exp(unknowns[:6]) @ T, points.T).T
        return (slope * distorted(moved[:2] / moved[2], own)).sum(axis=0) + 0.7 * moved[2]

    points = se3.transform_points(T, np.concatenate([rays * depths, depths[None]]).T).T
    found = derivatives(rays, points, T[:3, :2, None] * depths, values, slope, 0.7)
    for k, step in enumerate(1e-6 * np.eye(12)):
        expected = (residual(step) - residual(-step)) / 2e-6
        np.testing.assert_allclose(found[k], expected, atol=1e-6)
