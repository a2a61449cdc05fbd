"""Whether views determine their relative pose, direction by direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.alignment.backend import linearise
from toolkit.splatting.alignment.data import FrameLevel, LevelProblem, ResidualScales
from toolkit.splatting.alignment.determinacy import UNITS, Determinacy, _valley, determinacy
from toolkit.splatting.alignment.levels import model_level

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
SCALES = ResidualScales(0.01, 0.01)
ALONG = 1


def wall(seed: int, pattern: NDArray[np.float64] | float = 0.0) -> FrameLevel:
    """A wall at 1 m with a pattern, and 1 % of noise in its colour, 0.2 % in its depth."""
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((2, CAMERA.height, CAMERA.width))
    noise *= np.array([0.01, 0.002])[:, None, None]
    intensity = torch.from_numpy((0.5 + pattern + noise[0]).astype(np.float32))
    return FrameLevel(CAMERA, intensity, torch.from_numpy((1.0 + noise[1]).astype(np.float32)))


def measured(pattern: NDArray[np.float64] | float) -> Determinacy:
    model, frame = model_level(wall(0, pattern)), wall(1, pattern)
    return determinacy(LevelProblem(model, frame, np.eye(4), SCALES, IDENTITY, 0.1))


def columns_and_rows() -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    return x, y


def test_noise_determines_nothing_along_a_blank_wall_and_texture_does():
    x, y = columns_and_rows()
    texture = 0.1 * (np.sin(0.31 * x + 0.11 * y) + np.sin(0.23 * y - 0.07 * x))
    assert measured(0.0).rises[0] < 0.01
    assert measured(texture).rises.min() > 0.03


def test_stripes_determine_the_motion_across_them_only():
    x, _ = columns_and_rows()
    found = measured(0.2 * np.sin(0.3 * x))
    across, along, _ = np.diag(np.linalg.inv(found.in_frame(np.eye(4)) + np.eye(6)))[:3]
    assert along > 25.0 * across


def test_the_weakest_direction_is_that_along_stripes_and_not_one_of_noise():
    x, _ = columns_and_rows()
    for seed in range(4):
        pattern = 0.06 * np.sin(0.3 * x)
        model, frame = model_level(wall(2 * seed, pattern)), wall(2 * seed + 1, pattern)
        found = determinacy(LevelProblem(model, frame, np.eye(4), SCALES, IDENTITY, 0.1))
        free = found.directions[np.argmin(found.rises)] / UNITS
        assert abs(free[ALONG]) > 0.9 * np.linalg.norm(free)


def test_the_information_is_that_of_the_frames_own_axes():
    x, _ = columns_and_rows()
    found = measured(0.2 * np.sin(0.3 * x))
    T = se3.exp(np.array([0.1, -0.2, 0.3, 0.2, 0.1, np.pi / 2]))
    adjoint = se3.adjoint(T)
    expected = adjoint.T @ found.in_frame(np.eye(4)) @ adjoint
    np.testing.assert_allclose(found.in_frame(T), expected, rtol=1e-6, atol=1e-6 * expected.max())


def test_a_direction_that_is_not_quite_along_stripes_leads_to_the_one_that_is():
    x, _ = columns_and_rows()
    model, frame = (wall(seed, 0.2 * np.sin(0.3 * x)) for seed in (0, 1))
    problem = LevelProblem(model_level(model), frame, np.eye(4), SCALES, IDENTITY, 0.1)
    directions = np.diag(UNITS)
    slanted = directions[ALONG] + 0.3 * directions[0]
    cost = linearise(problem).cost
    rigid = linearise(replace(problem, T_model_frame=se3.exp(slanted))).cost / cost - 1.0
    found, rise = _valley(problem, cost, slanted, np.delete(directions, ALONG, axis=0))
    assert rigid > 0.5
    assert rise < 0.05
    assert abs(found[ALONG]) > 0.95 * UNITS[ALONG]
    assert abs(found[0]) < 0.1 * abs(slanted[0])


def test_the_rest_of_the_pose_does_not_explain_a_displacement_across_texture():
    x, y = columns_and_rows()
    texture = 0.1 * (np.sin(0.31 * x + 0.11 * y) + np.sin(0.23 * y - 0.07 * x))
    model, frame = model_level(wall(0, texture)), wall(1, texture)
    problem = LevelProblem(model, frame, np.eye(4), SCALES, IDENTITY, 0.1)
    assert determinacy(problem, refit=True).rises.min() > 0.03


def test_nothing_in_common_determines_nothing():
    empty = FrameLevel(CAMERA, torch.zeros(72, 96), torch.zeros(72, 96))
    problem = LevelProblem(model_level(wall(0)), empty, np.eye(4), SCALES, IDENTITY, 0.1)
    assert not determinacy(problem).rises.any()


def test_a_wall_that_is_darker_towards_its_foot_does_not_tell_a_motion_from_an_exposure():
    x, y = columns_and_rows()
    pattern = 0.2 * np.sin(0.3 * x) + 0.003 * y
    model, frame = (wall(seed, pattern) for seed in (0, 1))
    problem = LevelProblem(model_level(model), frame, np.eye(4), SCALES, IDENTITY, 0.1)
    along = np.eye(6)[ALONG] * UNITS
    fixed = linearise(replace(problem, T_model_frame=se3.exp(along))).cost / linearise(problem).cost
    found = determinacy(problem, refit=True)
    axis = found.directions[np.argmin(found.rises)] / UNITS
    assert fixed > 1.3
    assert found.rises.min() < 0.01 and abs(axis[ALONG]) > 0.9 * np.linalg.norm(axis)
