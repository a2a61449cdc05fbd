"""Resizing: images, depth and camera remain consistent."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.resize import ImageGrid
from toolkit.datasets.undistortion import Undistortion

SIZES = st.tuples(st.integers(8, 60), st.integers(8, 60))


def coordinate_images(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Images whose values are x and y of each pixel's ray."""
    rays = camera.rays().astype(np.float32)
    return rays[..., 0], rays[..., 1]


@settings(max_examples=60, deadline=None)
@given(source=SIZES, target=SIZES)
def test_pixels_keep_their_rays(source, target):
    camera = Camera(50.0, 45.0, source[0] / 2 + 3, source[1] / 2 - 2, *source)
    grid = ImageGrid(camera, target)
    assert grid.camera.size == target
    x, y = coordinate_images(camera)
    expected_x, expected_y = coordinate_images(grid.camera)
    # Excludes the border, where upsampling extrapolates.
    inner = np.s_[target[1] // 4 : -(target[1] // 4), target[0] // 4 : -(target[0] // 4)]
    rgb = grid.colour(np.stack([x, y, x], axis=-1))
    np.testing.assert_allclose(rgb[..., 0][inner], expected_x[inner], atol=2e-3)
    np.testing.assert_allclose(rgb[..., 1][inner], expected_y[inner], atol=2e-3)
    half_a_pixel = 0.501 / 45.0
    np.testing.assert_allclose(grid.nearest(x), expected_x, atol=half_a_pixel)
    np.testing.assert_allclose(grid.nearest(y), expected_y, atol=half_a_pixel)


def test_scale_is_uniform_and_the_crop_is_centred():
    camera = Camera(100.0, 100.0, 49.5, 49.5, 100, 100)
    resized = ImageGrid(camera, (50, 20)).camera
    assert (resized.fx, resized.fy) == (50, 50)
    assert (resized.cx, resized.cy) == (24.5, 9.5)


@settings(max_examples=60, deadline=None)
@given(source=SIZES, target=SIZES)
def test_plane_is_preserved(source, target):
    camera = Camera(50.0, 45.0, source[0] / 2 + 3, source[1] / 2 - 2, *source)
    x, y = coordinate_images(camera)
    plane = 1.0 / (0.5 + 0.05 * x + 0.1 * y)
    grid = ImageGrid(camera, target)
    x, y = coordinate_images(grid.camera)
    expected = 1.0 / (0.5 + 0.05 * x + 0.1 * y)
    # Partially covered pixels contribute with their centre, an error of an eighth of a pixel.
    smaller = max(target[0] / source[0], target[1] / source[1]) <= 1
    tolerance = 1e-3 if smaller else 0.02
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(grid.depth(plane)[inner], expected[inner], rtol=tolerance)


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_plane_downsampled_by_an_integer_factor_is_exact(factor):
    camera = Camera(100.0, 100.0, 59.5, 47.5, 120, 96)
    grid = ImageGrid(camera, (120 // factor, 96 // factor))
    (x, y), (new_x, new_y) = coordinate_images(camera), coordinate_images(grid.camera)
    made = grid.depth(1.0 / (0.5 + 0.1 * x + 0.2 * y))
    np.testing.assert_allclose(made, 1.0 / (0.5 + 0.1 * new_x + 0.2 * new_y), rtol=1e-6)


def test_surfaces_are_not_mixed_and_missing_depth_remains_missing():
    rng = np.random.default_rng(0)
    depth = rng.choice([0.0, 1.0, 2.0], size=(48, 64)).astype(np.float32)
    grid = ImageGrid(Camera(50, 50, 32, 24, 64, 48), (21, 17))
    resized = grid.depth(depth)
    assert resized.dtype == np.float32
    np.testing.assert_allclose(resized, grid.nearest(depth), rtol=1e-6)


def test_averaging_reduces_noise():
    rng = np.random.default_rng(0)
    depth = (1.0 / (0.5 + 0.002 * rng.standard_normal((96, 128)))).astype(np.float32)
    half = ImageGrid(Camera(100, 100, 63.5, 47.5, 128, 96), (64, 48)).depth(depth)
    assert np.std(1.0 / half) == pytest.approx(0.001, rel=0.1)


def test_labels_are_not_mixed():
    rng = np.random.default_rng(0)
    image = rng.choice([0, 7, 100], size=(48, 64)).astype(np.int32)
    resized = ImageGrid(Camera(50, 50, 32, 24, 64, 48), (21, 17)).nearest(image)
    assert resized.dtype == np.int32
    assert set(np.unique(resized)) <= {0, 7, 100}


def test_size_below_one_pixel_raises():
    with pytest.raises(DatasetError, match="0x24"):
        ImageGrid(Camera(50, 50, 32, 24, 64, 48), (0, 24))


def distort(x: np.ndarray, y: np.ndarray, k: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Brown-Conrady distortion model."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def test_undistortion_inverts_the_lens_model():
    camera = Camera(120.0, 118.0, 78.0, 62.0, 160, 120)
    k = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    columns, rows = np.meshgrid(np.arange(160.0), np.arange(120.0))
    source = np.stack([columns, rows, rows], axis=-1).astype(np.float32)
    rays = camera.rays()
    x, y = distort(rays[..., 0], rays[..., 1], k)
    expected = np.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy], axis=-1)
    inside = (expected >= 0).all(axis=-1) & (expected <= [159, 119]).all(axis=-1)
    assert inside.mean() > 0.9
    assert np.abs(expected - source[..., :2])[inside].max() > 2

    undistortion = Undistortion(camera, k)
    colour = undistortion.colour(source)[..., :2]
    np.testing.assert_allclose(colour[inside], expected[inside], atol=0.05)
    depth = undistortion.nearest(1 + source[..., 0])
    np.testing.assert_allclose(depth[inside] - 1, expected[inside][:, 0], atol=0.55)
    outside = (expected < -1).any(axis=-1) | (expected > [160, 120]).any(axis=-1)
    assert (depth[outside] == 0).all()
