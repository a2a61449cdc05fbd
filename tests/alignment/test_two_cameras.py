"""Alignment of a frame to a view of another camera: other focal lengths, other image sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_box import box_frame
from test_backends import assert_same_sums
from tracked_room import angle_deg, distance_mm

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.alignment import backend as backend_selection
from toolkit.splatting.alignment.backend import align, linearise
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    ModelLevel,
    ResidualScales,
)
from toolkit.splatting.alignment.levels import finest_level, model_level, pyramid

WIDE = Camera(60.0, 58.0, 40.5, 28.0, 80, 60)
LONG = Camera(84.0, 88.0, 37.0, 31.5, 80, 60)
LARGE = Camera(110.0, 112.0, 62.0, 50.0, 128, 100)
PAIRS = {
    "another focal length": (WIDE, LONG),
    "a larger frame": (WIDE, LARGE),
    "a larger model": (LARGE, WIDE),
}
T_MODEL_FRAME = se3.exp(np.array([0.03, -0.02, 0.025, 0.012, -0.01, 0.015]))
SCALES = ResidualScales(intensity=0.03, depth_m=0.005)
RULES = GaussNewtonOptions(
    12, 0.05, 1.0, IDENTITY, min_pixels=50, min_translation_m=2e-5, min_rotation_rad=1e-5
)

both_orders = pytest.mark.parametrize("cameras", PAIRS.values(), ids=PAIRS.keys())


def level_of(camera: Camera, T_map_camera: np.ndarray) -> FrameLevel:
    return finest_level(box_frame(0, T_map_camera, camera), torch.device("cpu"))


def levels_of(cameras: tuple[Camera, Camera]) -> tuple[list[ModelLevel], list[FrameLevel]]:
    """Pyramids of the model, seen from the map's origin, and of the frame at its true pose."""
    model, frame = cameras
    views = pyramid(level_of(model, np.eye(4)), 3)
    return [model_level(view) for view in views], pyramid(level_of(frame, T_MODEL_FRAME), 3)


def guarded(image: torch.Tensor) -> torch.Tensor:
    """The same image in memory that holds NaN before and after it."""
    guard = torch.full((64 * image.numel(),), float("nan"))
    return torch.cat([guard, image.reshape(-1), guard])[len(guard) : -len(guard)].view(image.shape)


def guarded_model(model: ModelLevel) -> ModelLevel:
    return ModelLevel(model.camera, guarded(model.texture), guarded(model.surface))


def guarded_frame(frame: FrameLevel) -> FrameLevel:
    return FrameLevel(frame.camera, guarded(frame.intensity), guarded(frame.depth_m))


@pytest.fixture(params=["native", "numpy"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alignment by the native kernels, and by numpy."""
    if request.param == "numpy":
        monkeypatch.setattr(backend_selection, "kernels_for", lambda tensor: None)


@both_orders
@pytest.mark.usefixtures("backend")
def test_the_pose_is_unbiased(cameras):
    models, frames = levels_of(cameras)
    found = align(models, frames, Alignment(np.eye(4), INITIAL_SCALES), RULES)
    assert found.converged
    assert distance_mm(found.T_view_camera, T_MODEL_FRAME) < 1.0
    assert angle_deg(found.T_view_camera, T_MODEL_FRAME) < 0.03


@both_orders
def test_residuals_vanish_at_the_true_pose(cameras, monkeypatch):
    """Every pixel of the frame whose point lies in the model's image has a residual."""
    monkeypatch.setattr(backend_selection, "kernels_for", lambda tensor: None)
    models, frames = levels_of(cameras)
    linear = linearise(LevelProblem(models[0], frames[0], T_MODEL_FRAME, SCALES, IDENTITY, 0.05))
    points = frames[0].camera.unproject(frames[0].depth_m.numpy()).reshape(-1, 3)
    uv = models[0].camera.project(se3.transform_points(T_MODEL_FRAME, points))
    inside = (uv >= 0).all(axis=1) & (uv < np.array(models[0].camera.size) - 1).all(axis=1)
    assert linear.frame_pixels == inside.sum()
    assert linear.depth_pixels > 0.7 * linear.frame_pixels
    assert linear.depth_variance < 0.1 and linear.intensity_variance < 0.1


@both_orders
def test_native_sums_are_those_of_numpy(cameras, module, monkeypatch):
    """Memory around each image holds NaN, which any read beyond the image would bring in."""
    models, frames = levels_of(cameras)
    T = se3.exp(np.array([0.004, -0.003, 0.005, 0.002, -0.003, 0.004])) @ T_MODEL_FRAME
    arguments = (T, SCALES, Exposure(1.1, -0.02), 0.05)
    monkeypatch.setattr(backend_selection, "kernels_for", lambda tensor: None)
    expected = linearise(LevelProblem(models[0], frames[0], *arguments))
    assert expected.depth_pixels > 500 and expected.intensity_pixels > 500
    monkeypatch.setattr(backend_selection, "kernels_for", lambda tensor: module)
    actual = linearise(LevelProblem(guarded_model(models[0]), guarded_frame(frames[0]), *arguments))
    assert_same_sums(actual, expected, 2e-3)


@pytest.mark.parametrize("field", ["intensity", "depth_m"])
def test_frame_images_must_have_the_size_of_their_camera(field):
    level = level_of(WIDE, np.eye(4))
    with pytest.raises(ValueError, match=rf"{field} must have shape \[60, 80\], got \[60, 79\]"):
        replace(level, **{field: getattr(level, field)[:, 1:]})


@pytest.mark.parametrize("field", ["texture", "surface"])
def test_model_images_must_have_the_size_of_their_camera(field):
    model = model_level(level_of(WIDE, np.eye(4)))
    with pytest.raises(ValueError, match=rf"{field} must have shape \[60, 80, 4\]"):
        replace(model, **{field: getattr(model, field)[1:]})
