"""Pinhole camera: projection round trips, resizing and cropping."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.errors import SettingsError
from toolkit.base.geometry.camera import Camera

PROFILE = settings(deadline=None, max_examples=50)

cameras = st.builds(
    Camera,
    fx=st.floats(5.0, 900.0),
    fy=st.floats(5.0, 900.0),
    cx=st.floats(-20.0, 90.0),
    cy=st.floats(-20.0, 90.0),
    width=st.integers(1, 60),
    height=st.integers(1, 60),
)
seeds = st.integers(0, 2**32 - 1)


@PROFILE
@given(camera=cameras, seed=seeds)
def test_project_undoes_unproject(camera: Camera, seed: int) -> None:
    depth_m = np.random.default_rng(seed).uniform(0.1, 8.0, (camera.height, camera.width))
    points = camera.unproject(depth_m)
    np.testing.assert_allclose(points[..., 2], depth_m)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    np.testing.assert_allclose(camera.project(points), np.stack([x, y], -1), atol=1e-9)


@PROFILE
@given(camera=cameras, seed=seeds)
def test_project_agrees_with_the_intrinsic_matrix(camera: Camera, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(0.2, 3.0, (7, 3))
    homogeneous = points @ camera.matrix.T
    np.testing.assert_allclose(
        camera.project(points), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-12
    )


def test_zero_depth_unprojects_to_the_camera_centre() -> None:
    assert not Camera(50, 50, 2, 2, 5, 4).unproject(np.zeros((4, 5))).any()


@PROFILE
@given(camera=cameras, seed=seeds, left=st.integers(0, 9), top=st.integers(0, 9))
def test_crop_shifts_pixels(camera: Camera, seed: int, left: int, top: int) -> None:
    points = np.random.default_rng(seed).uniform(0.2, 3.0, (7, 3))
    cropped = camera.cropped(left, top, 13, 11)
    np.testing.assert_allclose(
        cropped.project(points), camera.project(points) - [left, top], atol=1e-9
    )
    assert cropped.size == (13, 11)
    assert cropped.focal == camera.focal


@PROFILE
@given(
    camera=cameras,
    seed=seeds,
    scale_x=st.floats(0.1, 4.0),
    scale_y=st.floats(0.1, 4.0),
)
def test_scaling_moves_pixel_edges(
    camera: Camera, seed: int, scale_x: float, scale_y: float
) -> None:
    """The image's outer corner at (-0.5, -0.5) is the fixed point of the scaling."""
    points = np.random.default_rng(seed).uniform(0.2, 3.0, (7, 3))
    scaled = camera.scaled(scale_x, scale_y, 20, 30)
    expected = (camera.project(points) + 0.5) * [scale_x, scale_y] - 0.5
    np.testing.assert_allclose(scaled.project(points), expected, rtol=1e-9, atol=1e-9)
    back = scaled.scaled(1 / scale_x, 1 / scale_y, camera.width, camera.height)
    np.testing.assert_allclose(back.matrix, camera.matrix, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_scaling_fits_area_averaged_images(factor: int) -> None:
    """OpenCV's area resize of the image of rays yields the rays of the scaled camera."""
    camera = Camera(40.0, 55.0, 23.2, 16.7, 48, 36)
    small = camera.scaled(1 / factor, 1 / factor, 48 // factor, 36 // factor)
    resized = cv2.resize(camera.rays(), small.size, interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(resized, small.rays(), atol=1e-9)


@pytest.mark.parametrize(
    ("size", "expected"), [((8, 6), (4, 3)), ((9, 7), (4, 3)), ((1, 5), (1, 2))]
)
def test_halving_averages_two_by_two(size: tuple[int, int], expected: tuple[int, int]) -> None:
    camera = Camera(30.0, 40.0, 3.1, 2.2, *size)
    half = camera.halved()
    assert half.size == expected
    rays = camera.rays()
    if size[0] > 1:
        np.testing.assert_allclose(half.rays()[0, 0], rays[:2, :2].mean(axis=(0, 1)), atol=1e-12)


@pytest.mark.parametrize("step", [1, 3, 16])
def test_every_nth_pixel_is_unprojected_as_in_the_whole_image(step: int) -> None:
    camera = Camera(40.0, 55.0, 23.2, 16.7, 48, 37)
    depth_m = np.random.default_rng(0).uniform(0.5, 4.0, (37, 48)).astype(np.float32)
    expected = camera.unproject(depth_m)[step // 2 :: step, step // 2 :: step]
    np.testing.assert_array_equal(camera.unproject(depth_m, step), expected)


def test_focal_is_the_geometric_mean() -> None:
    assert Camera(200.0, 50.0, 0, 0, 4, 4).focal == pytest.approx(100.0)


@pytest.mark.parametrize(
    "change",
    [
        {"fx": 0.0},
        {"fy": -3.0},
        {"cx": math.nan},
        {"cy": math.inf},
        {"fx": math.inf},
        {"width": 0},
        {"height": -1},
    ],
)
def test_invalid_intrinsics_raise(change: dict) -> None:
    values = {"fx": 50.0, "fy": 50.0, "cx": 2.0, "cy": 2.0, "width": 5, "height": 4}
    with pytest.raises(SettingsError, match="camera"):
        Camera(**(values | change))


def test_depth_of_a_different_size_raises() -> None:
    with pytest.raises(ValueError, match=r"depth must have shape \[4, 5\], got \[5, 4\]"):
        Camera(50, 50, 2, 2, 5, 4).unproject(np.zeros((5, 4)))
