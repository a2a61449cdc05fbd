"""Whether views determine their relative pose."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.alignment.covariance import weakest_rise
from toolkit.alignment.data import FrameLevel, LevelProblem, ResidualScales
from toolkit.alignment.levels import model_level
from toolkit.exposure import IDENTITY
from toolkit.geometry.camera import Camera

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
SCALES = ResidualScales(0.01, 0.01)


def wall(seed: int, texture: float) -> FrameLevel:
    """A wall at 1 m with 1 % of noise, and a texture of a certain contrast."""
    rng = np.random.default_rng(seed)
    noise = 0.01 * rng.standard_normal((2, CAMERA.height, CAMERA.width))
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    pattern = texture * (np.sin(0.31 * x + 0.11 * y) + np.sin(0.23 * y - 0.07 * x))
    intensity = torch.from_numpy((0.5 + pattern + noise[0]).astype(np.float32))
    return FrameLevel(CAMERA, intensity, torch.from_numpy((1.0 + noise[1]).astype(np.float32)))


def rise(texture: float) -> float:
    model, frame = model_level(wall(0, texture)), wall(1, texture)
    return weakest_rise(LevelProblem(model, frame, np.eye(4), SCALES, IDENTITY, 0.1))


def test_noise_determines_nothing_and_texture_does():
    assert rise(0.0) < 0.03
    assert rise(0.1) > 0.03


def test_nothing_in_common_determines_nothing():
    empty = FrameLevel(CAMERA, torch.zeros(72, 96), torch.zeros(72, 96))
    model = model_level(wall(0, 0.1))
    problem = LevelProblem(model, empty, np.eye(4), SCALES, IDENTITY, 0.1)
    assert weakest_rise(problem) == 0.0
