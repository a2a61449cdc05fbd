"""Exposure in the normal equations: removed, or with a prior."""

from __future__ import annotations

import numpy as np

from toolkit.splatting.alignment.gauss_newton import add_exposure_prior, fix_exposure


def equations(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    J = generator.normal(size=(40, 8))
    return J.T @ J, J.T @ generator.normal(size=40)


def test_fixed_exposure_has_no_step_and_does_not_change_the_pose():
    H, g = equations()
    alone = np.linalg.solve(H[:6, :6], g[:6])
    fix_exposure(H, g)
    step = np.linalg.solve(H, g)
    assert np.array_equal(step[6:], [0.0, 0.0])
    assert np.allclose(step[:6], alone)


def test_the_prior_returns_to_the_previous_exposure():
    """Without photometric residuals, the prior alone decides."""
    change = np.array([0.3, -0.1])
    H, g = np.diag([1.0] * 6 + [0.0] * 2), np.zeros(8)
    add_exposure_prior(H, g, 1000.0, change)
    step = -np.linalg.solve(H, g)
    assert np.allclose(step[6:], -change)
    assert not step[:6].any()


def test_the_prior_is_the_derivative_of_a_quadratic_cost():
    change = np.array([0.3, -0.1])
    H, g = np.zeros((8, 8)), np.zeros(8)
    add_exposure_prior(H, g, 500.0, change)
    weight = H[6, 6]
    assert weight == H[7, 7] > 0
    assert np.allclose(g[6:], weight * change)
