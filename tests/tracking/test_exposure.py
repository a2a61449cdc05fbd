"""Exposure in the normal equations: fixed, held; and what of it the map is told."""

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
    return np.random.default_rng(0).uniform(0.1, 0.9, 4000)


def blurred(image, contrast=0.97):
    return image.mean() + contrast * (image - image.mean())


def told(frame, model, at=(1.0, 0.0)):
    """What the equations of a fit say, through `tones` and `exposure_between`."""
    J = np.zeros((len(frame), 8))
    J[:, exposure.GAIN], J[:, exposure.BIAS] = -frame, -1.0
    residual = model - (at[0] * frame + at[1])
    weight = 1.0 / 0.05**2
    H, g = weight * J.T @ J, weight * J.T @ residual
    return exposure.exposure_between(*exposure.tones(H, g, weight * float(residual @ residual), at))


@pytest.mark.parametrize("at", [(1.0, 0.0), (0.8, 0.1)])
def test_tones_do_not_depend_on_where_they_were_told(image, at):
    model = 1.2 * image - 0.05
    frame, view = (
        exposure.Tones(image.mean(), image.std()),
        exposure.Tones(model.mean(), model.std()),
    )
    assert told(image, model, at) == pytest.approx(exposure.exposure_between(frame, view))


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.3])
def test_a_smoother_map_and_a_noisy_image_take_no_contrast(image, factor):
    noisy = image + 0.02 * np.random.default_rng(1).normal(size=image.shape)
    gain, bias = told(noisy, factor * blurred(image))
    fitted = np.polyfit(noisy, factor * blurred(image), 1)
    assert fitted[0] < 0.97 * factor, "least squares would"
    assert (gain, bias) == (pytest.approx(factor, rel=0.01), 0.0)


@pytest.mark.parametrize(("gain", "bias"), [(1.2, 0.1), (0.8, 0.1), (0.75, -0.05)])
def test_a_camera_that_changes_contrast_is_followed(image, gain, bias):
    assert told(image, gain * image + bias) == pytest.approx((gain, bias), abs=1e-6)


def test_a_flat_view_tells_a_factor_and_a_black_one_nothing(image):
    flat = np.full_like(image, 0.5)
    assert told(0.8 * flat, flat) == (pytest.approx(1.25), 0.0)
    assert told(0.01 * image, image) == (1.0, 0.0)
    nothing = exposure.tones(np.zeros((8, 8)), np.zeros(8), 0.0, (1.0, 0.0))
    assert exposure.exposure_between(*nothing) == (1.0, 0.0)
