"""Alignment as on a GPU: its kernels, through Triton's interpreter, against the CPU's way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from painted_box import box_frame, box_frames, path
from test_backends import SCALES, assert_close, assert_same_sums, level_of
from tracked_room import Room, angle_deg, distance_mm

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native import kernels_for
from toolkit.base.native.constants import SILHOUETTE
from toolkit.splatting.alignment import reference
from toolkit.splatting.alignment.backend import align, linearise
from toolkit.splatting.alignment.cuda import images as torch_images
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    ModelLevel,
)
from toolkit.splatting.alignment.levels import finest_level, model_level, pyramid

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture(scope="module")
def room() -> Room:
    """Of the tests' own making: a GPU server seldom has Open3D."""
    T_map_camera = path(2)
    return Room(box_frames(T_map_camera, 96, 72), T_map_camera)


@pytest.fixture
def backend():
    """The launcher of the kernels, in memory that holds NaN where nothing was written."""
    pytest.importorskip("triton", reason="triton is not installed")
    rendering = pytest.importorskip("toolkit.splatting.rendering.cuda.backend")
    if DEVICE == "cpu" and not rendering.interpreted():
        pytest.skip("no GPU, and triton was imported to compile")
    from toolkit.splatting.alignment.cuda.backend import CudaAlignment

    torch.set_deterministic_debug_mode("warn")
    yield CudaAlignment()
    torch.set_deterministic_debug_mode("default")


def there(level: FrameLevel) -> FrameLevel:
    return FrameLevel(level.camera, level.intensity.to(DEVICE), level.depth_m.to(DEVICE))


def model_there(level: ModelLevel) -> ModelLevel:
    return ModelLevel(level.camera, level.texture.to(DEVICE), level.surface.to(DEVICE))


def skewed(level: FrameLevel) -> FrameLevel:
    """The same images by a camera whose axes cannot be mistaken for each other."""
    camera = replace(level.camera, fx=1.1 * level.camera.fx, fy=0.9 * level.camera.fy)
    return replace(level, camera=camera)


def test_sums(room, backend):
    frame, view = skewed(level_of(room, 1, 45, 33)), skewed(level_of(room, 0, 45, 33))
    pose = se3.inverse(room.T_map_camera[0]) @ room.T_map_camera[1]
    pose = se3.exp(np.array([0.004, -0.003, 0.005, 0.002, -0.003, 0.004])) @ pose
    model = model_level(view)
    arguments = (pose, SCALES, Exposure(1.1, -0.02), 0.05)
    expected = linearise(LevelProblem(model, frame, *arguments))
    assert expected.depth_pixels > 500 and expected.intensity_pixels > 500
    actual = backend.linearise(LevelProblem(model_there(model), there(frame), *arguments))
    assert_same_sums(actual, expected, 2e-3)


@pytest.mark.parametrize(("levels", "exposure"), [(2, True), (1, False)])
def test_all_steps_end_where_the_cpu_ends(room, backend, levels, exposure):
    """Level by level, with exposure and scales, as often, to a hundredth of a millimetre."""
    previous = IDENTITY if exposure else None
    rules = GaussNewtonOptions(5, 0.05, 0.4, previous, 50, 2e-5, 1e-5)
    view = [model_level(level) for level in pyramid(level_of(room, 0, 32, 24), levels)]
    frames = pyramid(level_of(room, 1, 32, 24), levels)
    offset = se3.exp(np.array([0.004, -0.003, 0.005, 0.002, -0.003, 0.004]))
    start = Alignment(offset, INITIAL_SCALES)
    expected = align(view, frames, start, rules)
    views_there, frames_there = [model_there(v) for v in view], [there(f) for f in frames]
    actual = backend.align(views_there, frames_there, start, rules)
    assert distance_mm(actual.T_view_camera, expected.T_view_camera) < 0.01
    assert angle_deg(actual.T_view_camera, expected.T_view_camera) < 0.001
    assert actual.exposure.gain == pytest.approx(expected.exposure.gain, abs=1e-4)
    assert actual.exposure.bias == pytest.approx(expected.exposure.bias, abs=1e-4)
    assert actual.scales.intensity == pytest.approx(expected.scales.intensity, rel=1e-3)
    assert actual.scales.depth_m == pytest.approx(expected.scales.depth_m, rel=1e-3)
    assert actual.iterations == expected.iterations
    assert actual.converged == expected.converged
    assert expected.last is not None and actual.last is not None
    assert_same_sums(actual.last, expected.last, 2e-3)


def test_a_large_step_is_a_rigid_motion(room, backend):
    """Products of rotation and translation show only in large steps."""
    view, frame = model_level(level_of(room, 0, 32, 24)), level_of(room, 1, 32, 24)
    away = se3.exp(np.array([0.06, -0.05, 0.07, 0.09, -0.08, 0.1]))
    rules = GaussNewtonOptions(1, 1.0, 1.0, None, 50, 1e-5, 1e-5)
    start = Alignment(away, INITIAL_SCALES)
    expected = align([view], [frame], start, rules)
    found = backend.align([model_there(view)], [there(frame)], start, rules)
    step = expected.T_view_camera @ se3.inverse(away)
    assert np.linalg.norm(step[:3, 3]) > 0.05 and se3.rotation_angle_rad(step[:3, :3]) > 0.05
    assert distance_mm(found.T_view_camera, expected.T_view_camera) < 0.2
    assert angle_deg(found.T_view_camera, expected.T_view_camera) < 0.02


def test_too_few_pixels_change_nothing(room, backend):
    frame, view = level_of(room, 1, 20, 16), level_of(room, 0, 20, 16)
    frame.depth_m[:] = 0.0
    start = Alignment(np.eye(4), INITIAL_SCALES)
    rules = GaussNewtonOptions(3, 0.05, 1.0, IDENTITY, 50, 1e-5, 1e-5)
    found = backend.align([model_there(model_level(view))], [there(frame)], start, rules)
    assert np.array_equal(found.T_view_camera, np.eye(4))
    assert (found.iterations, found.converged, found.exposure) == (1, False, IDENTITY)


def test_too_few_pixels_end_the_alignment(room, backend):
    """Of a coarse level, although the finer one has enough."""
    view = [model_level(level) for level in pyramid(level_of(room, 0, 32, 24), 2)]
    frames = pyramid(level_of(room, 1, 32, 24), 2)
    frames[1].depth_m[:] = 0.0
    start = Alignment(np.eye(4), INITIAL_SCALES)
    rules = GaussNewtonOptions(3, 0.05, 1.0, IDENTITY, 50, 1e-5, 1e-5)
    expected = align(view, frames, start, rules)
    found = backend.align([model_there(v) for v in view], [there(f) for f in frames], start, rules)
    assert (found.iterations, found.converged) == (expected.iterations, False) == (1, False)
    assert np.array_equal(found.T_view_camera, np.eye(4))


@pytest.mark.parametrize("size", [(95, 71), (1, 9), (8, 1), (2, 2)])
def test_torch_computes_what_numpy_does(room, size):
    """Pyramids and models, which a GPU makes with torch."""
    level = level_of(room, 0, *size)
    arrays = level.intensity.numpy(), level.depth_m.numpy()
    half = torch_images.halve(*(t.to(DEVICE) for t in (level.intensity, level.depth_m)), 0.1)
    for actual, expected in zip(half, reference.halve(*arrays, 0.1), strict=True):
        assert_close(actual.cpu()[..., None], torch.from_numpy(expected)[..., None], few=2)
    made = torch_images.model(level.camera, level.intensity, level.depth_m)
    for actual, expected in zip(made, reference.model(level.camera, *arrays), strict=True):
        assert_close(actual, torch.from_numpy(expected), few=2)
    images = torch.rand(5, *reversed(size), generator=torch.Generator().manual_seed(0))
    images[SILHOUETTE, 0] = 0.5
    expected = reference.intensity_of(images.numpy(), 0.5)
    assert_close(
        torch_images.intensity_of(images, 0.5)[..., None], torch.from_numpy(expected)[..., None]
    )
    assert (expected[0] > 0.0).all()


def test_kernels_of_the_cpu_keep_away_from_other_devices():
    assert kernels_for(torch.empty(1, device="meta")) is None


@pytest.mark.parametrize("widths", [(24, 32), (32, 24)])
def test_cameras_of_model_and_frame_may_differ(backend, widths):
    """Sums and steps: with other focal lengths, and with either image the larger one."""
    model_camera, frame_camera = (
        Camera(0.8 * width, 0.7 * width, 0.52 * width, 0.3 * width, width, 3 * width // 4)
        for width in widths
    )
    frame_camera = replace(frame_camera, fx=1.3 * frame_camera.fx, fy=1.2 * frame_camera.fy)
    T = se3.exp(np.array([0.01, -0.008, 0.009, 0.004, -0.005, 0.006]))
    cpu = torch.device("cpu")
    views = pyramid(finest_level(box_frame(0, np.eye(4), model_camera), cpu), 2)
    models = [model_level(level) for level in views]
    frames = pyramid(finest_level(box_frame(1, T, frame_camera), cpu), 2)
    models_there, frames_there = [model_there(m) for m in models], [there(f) for f in frames]
    arguments = (se3.exp(np.full(6, 0.003)) @ T, SCALES, Exposure(1.1, -0.02), 0.05)
    expected = linearise(LevelProblem(models[0], frames[0], *arguments))
    assert expected.depth_pixels > 100 and expected.intensity_pixels > 100
    actual = backend.linearise(LevelProblem(models_there[0], frames_there[0], *arguments))
    assert_same_sums(actual, expected, 2e-3)
    rules = GaussNewtonOptions(
        1, 0.05, 1.0, IDENTITY, min_pixels=50, min_translation_m=2e-5, min_rotation_rad=1e-5
    )
    start = Alignment(np.eye(4), INITIAL_SCALES)
    found = backend.align(models_there, frames_there, start, rules)
    assert (
        distance_mm(found.T_view_camera, align(models, frames, start, rules).T_view_camera) < 0.01
    )
