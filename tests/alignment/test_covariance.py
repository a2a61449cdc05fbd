"""Information from residual blocks: it follows correlated errors, which pixel counts ignore."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.splatting.alignment.covariance import clustered_information
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.joint import Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import keyframe_level, model_level

OPTIONS = JointOptions(levels=1)


@pytest.fixture(scope="module")
def level() -> FrameLevel:
    (frame,), _ = tiny_room(1, 96, 72)
    return keyframe_level(Keyframe.from_frame(frame, np.eye(4)))


def information(level: FrameLevel, noise_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clustered and Gauss-Newton information of a view aligned to itself with noise.

    Args:
        noise_m: [H, W] added to the depth, and four times as much to the intensity.
    """
    depth_m = level.depth_m + torch.from_numpy(noise_m.astype(np.float32))
    intensity = level.intensity + torch.from_numpy(4.0 * noise_m.astype(np.float32))
    return information_of_pair(level, replace(level, depth_m=depth_m, intensity=intensity))


def information_of_pair(level: FrameLevel, frame: FrameLevel) -> tuple[np.ndarray, np.ndarray]:
    """Clustered and Gauss-Newton information of a frame aligned to a view."""
    pair = Pair([model_level(level)], [frame], np.eye(4), np.eye(4))
    estimate = Estimate(np.eye(4))
    for _ in range(5):  # until the scales of the residuals are those of the noise
        estimate = align([pair], estimate, OPTIONS)
    return clustered_information([pair], estimate, OPTIONS), estimate.information


def noises(level: FrameLevel) -> tuple[np.ndarray, np.ndarray]:
    """Noise [H, W] of equal variance: independent in each pixel, and constant in patches."""
    generator = np.random.default_rng(3)
    height, width = level.depth_m.shape
    patches = generator.normal(0.0, 0.005, (height // 12, width // 12))
    return generator.normal(0.0, 0.005, (height, width)), np.kron(patches, np.ones((12, 12)))


def test_independent_noise_has_about_the_information_of_its_pixels(level):
    clustered, counted = information(level, noises(level)[0])
    ratio = np.linalg.eigvals(np.linalg.solve(counted, clustered)).real
    assert 0.1 < np.median(ratio) <= 1.0


def test_correlated_noise_has_much_less(level):
    independent, correlated = noises(level)
    clustered, counted = information(level, correlated)
    ratio = np.linalg.eigvals(np.linalg.solve(counted, clustered)).real
    assert np.median(ratio) < 0.1
    assert np.trace(clustered) < 0.5 * np.trace(information(level, independent)[0])


def test_it_is_symmetric_and_positive(level):
    clustered, _ = information(level, noises(level)[1])
    assert np.array_equal(clustered, clustered.T) and np.linalg.eigvalsh(clustered)[0] > 0


def test_without_residuals_there_is_no_information(level):
    blind = replace(level, depth_m=torch.zeros_like(level.depth_m))
    pair = Pair([model_level(level)], [blind], np.eye(4), np.eye(4))
    estimate = replace(Estimate(np.eye(4)), exposures=np.array([[1.0, 0.0]]))
    assert not clustered_information([pair], estimate, OPTIONS).any()


def test_terms_that_contradict_each_other_have_less_information(level):
    """Depth errors of the whole image move the motion that depth alone would choose."""
    small = noises(level)[0] * 0.2
    across = torch.linspace(-1.0, 1.0, level.camera.width)
    tilted = replace(level, depth_m=level.depth_m * (1.0 + 0.02 * across))
    consistent, _ = information(level, small)
    contradictory, _ = information_of_pair(level, tilted)
    assert np.trace(contradictory) < 0.2 * np.trace(consistent)


def test_depth_in_few_blocks_and_no_texture_are_not_a_contradiction(level):
    grey = replace(level, intensity=torch.full_like(level.intensity, 0.5))
    depth_m = level.depth_m.clone()
    depth_m[:, level.camera.width // 2 :] = 0.0
    with np.errstate(all="raise"):
        found, _ = information_of_pair(grey, replace(grey, depth_m=depth_m))
    assert np.isfinite(found).all()
