"""Exposure from mean and deviation: noise and smoothness do not reduce the contrast."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.alignment.data import FrameLevel, ResidualScales
from toolkit.splatting.alignment.exposure import (
    IntensityStatistics,
    estimate_exposure,
    exposure_between,
    exposure_between_images,
    intensity_statistics,
)
from toolkit.splatting.alignment.gauss_newton import BIAS, GAIN
from toolkit.splatting.alignment.levels import model_level, pyramid


@pytest.fixture
def image():
    return np.random.default_rng(0).uniform(0.1, 0.9, 4000)


def gain_and_bias(exposure: Exposure) -> tuple[float, float]:
    """Intensities do not determine the white balance."""
    return exposure.gain, exposure.bias


def blurred(image, contrast=0.97):
    return image.mean() + contrast * (image - image.mean())


def estimated(frame, model, at=IDENTITY):
    """Gain and bias from the normal equations of a fit at some exposure."""
    J = np.zeros((len(frame), 8))
    J[:, GAIN], J[:, BIAS] = -frame, -1.0
    residual = model - (at.gain * frame + at.bias)
    weight = 1.0 / 0.05**2
    H, g = weight * J.T @ J, weight * J.T @ residual
    squares = weight * float(residual @ residual)
    return gain_and_bias(exposure_between(*intensity_statistics(H, g, squares, at)))


@pytest.mark.parametrize("at", [IDENTITY, Exposure(0.8, 0.1)])
def test_statistics_do_not_depend_on_the_linearisation_point(image, at):
    model = 1.2 * image - 0.05
    frame, view = (
        IntensityStatistics(image.mean(), image.std()),
        IntensityStatistics(model.mean(), model.std()),
    )
    assert estimated(image, model, at) == pytest.approx(
        gain_and_bias(exposure_between(frame, view))
    )


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.3])
def test_a_smooth_map_and_a_noisy_image_do_not_reduce_the_contrast(image, factor):
    noisy = image + 0.02 * np.random.default_rng(1).normal(size=image.shape)
    gain, bias = estimated(noisy, factor * blurred(image))
    fitted = np.polyfit(noisy, factor * blurred(image), 1)
    assert fitted[0] < 0.97 * factor, "least squares is biased"
    assert (gain, bias) == (pytest.approx(factor, rel=0.01), 0.0)


@pytest.mark.parametrize(("gain", "bias"), [(1.2, 0.1), (0.8, 0.1), (0.75, -0.05)])
def test_changes_of_contrast_are_estimated(image, gain, bias):
    assert estimated(image, gain * image + bias) == pytest.approx((gain, bias), abs=1e-6)


def test_the_bias_between_images_is_bounded(image):
    small = exposure_between_images(0.9 * image + 0.03, image)
    assert small is not None
    assert gain_and_bias(small) == pytest.approx((0.9, 0.03), abs=1e-3)
    reference = 0.8 * image + 0.08
    large = exposure_between_images(reference, image)
    assert large is not None
    assert large.bias == 0.04
    assert large.apply(image).mean() == pytest.approx(reference.mean(), abs=0.01)


def test_a_flat_view_gives_a_gain_and_a_black_one_no_exposure(image):
    flat = np.full_like(image, 0.5)
    assert estimated(0.8 * flat, flat) == (pytest.approx(1.25), 0.0)
    assert estimated(0.01 * image, image) == (1.0, 0.0)
    nothing = intensity_statistics(np.zeros((8, 8)), np.zeros(8), 0.0, IDENTITY)
    assert exposure_between(*nothing) == IDENTITY


class TestFrame:
    """A slanted wall against a view of it at another exposure."""

    CAMERA = Camera(100.0, 100.0, 63.5, 47.5, 128, 96)

    def levels(self, gain, bias, holes=None):
        picture = np.random.default_rng(3).uniform(0.2, 0.7, (12, 16))
        intensity = torch.from_numpy(np.kron(picture, np.ones((8, 8))).astype(np.float32))
        depth = torch.full_like(intensity, 2.0)
        frame = FrameLevel(self.CAMERA, intensity, depth)
        rendered, measured = gain * intensity + bias, depth.clone()
        if holes is not None:
            rendered[holes], measured[holes] = 0.0, 0.0
        view = pyramid(FrameLevel(self.CAMERA, rendered, measured), 3)
        return list(zip([model_level(v) for v in view], pyramid(frame, 3), strict=True))

    def estimated(self, levels, fitted=IDENTITY):
        scales = ResidualScales(0.05, 0.01)
        return gain_and_bias(estimate_exposure(levels, np.eye(4), scales, fitted, 0.05))

    @pytest.mark.parametrize("exposure", [(1.2, 0.0), (0.85, 0.0), (0.7, 0.15), (1.3, -0.05)])
    def test_the_exposure_is_estimated(self, exposure):
        assert self.estimated(self.levels(*exposure)) == pytest.approx(exposure, abs=0.01)

    def test_small_changes_are_ignored(self):
        assert self.estimated(self.levels(1.01, 0.0)) == (1.0, 0.0)

    def test_holes_of_the_view_do_not_matter(self):
        holes = torch.from_numpy(np.random.default_rng(4).random((96, 128)) < 0.15)
        assert self.estimated(self.levels(1.2, 0.0, holes)) == pytest.approx((1.2, 0.0), abs=0.02)

    def test_without_common_pixels_there_is_no_exposure(self):
        everywhere = torch.ones(96, 128, dtype=torch.bool)
        assert self.estimated(self.levels(1.2, 0.0, everywhere), Exposure(0.9, 0.1)) == (1.0, 0.0)
