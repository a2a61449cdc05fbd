"""Exposure by brightness and contrast: nothing is lost to noise or smoothness."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.geometry.camera import Camera
from toolkit.tracking.alignment import FrameLevel, Scales, model_level, pyramid
from toolkit.tracking.exposure import BIAS, GAIN
from toolkit.tracking.tones import Tones, exposure_between, told_exposure, tones


@pytest.fixture
def image():
    return np.random.default_rng(0).uniform(0.1, 0.9, 4000)


def blurred(image, contrast=0.97):
    return image.mean() + contrast * (image - image.mean())


def told(frame, model, at=(1.0, 0.0)):
    """What the equations of a fit say, through `tones` and `exposure_between`."""
    J = np.zeros((len(frame), 8))
    J[:, GAIN], J[:, BIAS] = -frame, -1.0
    residual = model - (at[0] * frame + at[1])
    weight = 1.0 / 0.05**2
    H, g = weight * J.T @ J, weight * J.T @ residual
    return exposure_between(*tones(H, g, weight * float(residual @ residual), at))


@pytest.mark.parametrize("at", [(1.0, 0.0), (0.8, 0.1)])
def test_tones_do_not_depend_on_where_they_were_told(image, at):
    model = 1.2 * image - 0.05
    frame, view = (
        Tones(image.mean(), image.std()),
        Tones(model.mean(), model.std()),
    )
    assert told(image, model, at) == pytest.approx(exposure_between(frame, view))


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
    nothing = tones(np.zeros((8, 8)), np.zeros(8), 0.0, (1.0, 0.0))
    assert exposure_between(*nothing) == (1.0, 0.0)


class TestOfAFrame:
    """A slanted wall against a view of it at another exposure."""

    CAMERA = Camera(100.0, 100.0, 63.5, 47.5, 128, 96)

    def levels(self, gain, bias, holes=None):
        picture = np.random.default_rng(3).uniform(0.2, 0.7, (12, 16))
        intensity = torch.from_numpy(np.kron(picture, np.ones((8, 8))).astype(np.float32))
        depth = torch.full_like(intensity, 2.0)
        frame = FrameLevel(self.CAMERA, intensity, depth)
        shown, seen = gain * intensity + bias, depth.clone()
        if holes is not None:
            shown[holes], seen[holes] = 0.0, 0.0
        view = pyramid(FrameLevel(self.CAMERA, shown, seen), 3)
        return list(zip([model_level(v) for v in view], pyramid(frame, 3), strict=True))

    def told(self, levels, fitted=(1.0, 0.0)):
        return told_exposure(levels, np.eye(4), Scales(0.05, 0.01), fitted, 0.05)

    @pytest.mark.parametrize("exposure", [(1.2, 0.0), (0.85, 0.0), (0.7, 0.15), (1.3, -0.05)])
    def test_it_is_told(self, exposure):
        assert self.told(self.levels(*exposure)) == pytest.approx(exposure, abs=0.01)

    def test_small_changes_are_none(self):
        assert self.told(self.levels(1.01, 0.0)) == (1.0, 0.0)

    def test_holes_of_the_view_do_not_matter(self):
        holes = torch.from_numpy(np.random.default_rng(4).random((96, 128)) < 0.15)
        assert self.told(self.levels(1.2, 0.0, holes)) == pytest.approx((1.2, 0.0), abs=0.02)

    def test_nothing_in_common_tells_nothing(self):
        everywhere = torch.ones(96, 128, dtype=torch.bool)
        assert self.told(self.levels(1.2, 0.0, everywhere), (0.9, 0.1)) == (1.0, 0.0)
