"""Exposure in the normal equations: fixed, held, and what is believed of it."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.tracking import exposure


def equations(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    J = generator.normal(size=(40, 8))
    return J.T @ J, J.T @ generator.normal(size=40)


def test_fixed_exposure_takes_no_step_and_leaves_the_pose_its_own():
    H, g = equations()
    alone = np.linalg.solve(H[:6, :6], g[:6])
    exposure.fix(H, g)
    step = np.linalg.solve(H, g)
    assert np.array_equal(step[6:], [0.0, 0.0])
    assert np.allclose(step[:6], alone)


def test_held_exposure_goes_back_to_the_last_frames():
    """The prior alone decides where the pixels say nothing."""
    change = np.array([0.3, -0.1])
    H, g = np.diag([1.0] * 6 + [0.0] * 2), np.zeros(8)
    exposure.hold(H, g, 1000.0, change)
    step = -np.linalg.solve(H, g)
    assert np.allclose(step[6:], -change)
    assert not step[:6].any()


def test_holding_is_the_derivative_of_a_quadratic_cost():
    change = np.array([0.3, -0.1])
    H, g = np.zeros((8, 8)), np.zeros(8)
    exposure.hold(H, g, 500.0, change)
    weight = H[6, 6]
    assert weight == H[7, 7] > 0
    assert np.allclose(g[6:], weight * change)


@pytest.fixture
def image():
    return np.random.default_rng(0).uniform(0.1, 0.9, 2000)


def fitted(image, model):
    """Gain and bias by least squares, and the normal equations they came from."""
    J = np.stack([image, np.ones_like(image)], axis=1)
    H = np.zeros((8, 8))
    H[exposure.GAIN :, exposure.GAIN :] = J.T @ J
    gain, bias = np.linalg.solve(J.T @ J, J.T @ model)
    return gain, bias, H


@pytest.mark.parametrize("true", [0.8, 1.0, 1.3])
def test_a_smoother_map_and_a_noisy_image_change_no_exposure(image, true):
    smooth = true * (image.mean() + 0.9 * (image - image.mean()))
    noisy = image + 0.05 * np.random.default_rng(1).normal(size=image.shape)
    gain, bias, H = fitted(noisy, smooth)
    assert gain < 0.95 * true and bias > 0.0, "what the fit says is not to be believed"
    assert exposure.brightness_ratio(gain, bias, H) == pytest.approx(true, rel=0.01)


def test_a_black_image_tells_no_exposure(image):
    assert exposure.brightness_ratio(0.5, 0.2, np.zeros((8, 8))) == 1.0
    assert exposure.brightness_ratio(*fitted(0.01 * image, image)) == 1.0
