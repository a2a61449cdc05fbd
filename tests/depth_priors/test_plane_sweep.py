"""Plane sweep of one image."""

from __future__ import annotations

import numpy as np
import pytest
from swept_box import CAMERA, IMAGES, NEAR, TRUE, posed, relative_error, use_kernels

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native import available_instruction_sets
from toolkit.depth.depth_priors.plane_sweep import double_depth, plane_sweep
from toolkit.depth.depth_priors.problem import NeighbourView, Planes, SweptPlanes


def planes(count: int, far: float = 0.2, near: float = 1.0) -> Planes:
    return Planes(np.full_like(IMAGES[0], far), (near - far) / (count - 1), count)


def inverse_depth(found: SweptPlanes, used: Planes) -> np.ndarray:
    return np.where(found.plane < 0, 0.0, used.first + found.plane * used.step)


@pytest.mark.parametrize("name", available_instruction_sets())
def test_depth_is_found_nearly_everywhere(name, monkeypatch):
    use_kernels(monkeypatch, name)
    found = plane_sweep(CAMERA, IMAGES[2], posed(IMAGES, 2, 0, 1, 3, 4), planes(48))
    assert (found.plane >= 0).mean() > 0.9
    error = relative_error(inverse_depth(found, planes(48)), 2)
    assert np.median(error) < 0.015
    assert (error > 0.2).mean() < 0.05


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("size", [(61, 47), (160, 21), (9, 50)])
def test_kernels_agree_with_the_reference(name, size, monkeypatch):
    """Also where tiles, vectors and blocks of planes are incomplete."""
    camera = CAMERA.cropped(0, 0, *size)
    images = [np.ascontiguousarray(image[: size[1], : size[0]]) for image in IMAGES]
    # Planes that are not parallel to the image.
    slope = np.linspace(0.2, 0.3, size[0], dtype=np.float32)
    compared = Planes(np.ascontiguousarray(np.tile(slope, (size[1], 1))), 0.04, 19)
    results = []
    for kernels in (None, name):
        use_kernels(monkeypatch, kernels)
        results.append(plane_sweep(camera, images[1], posed(images, 1, 0, 2, 3), compared))
    expected, found = results
    # Rounding of a cost changes the choice between planes that fit equally well.
    assert (np.abs(found.plane - expected.plane) < 0.1).mean() > 0.99
    assert np.abs(found.correlation - expected.correlation).mean() < 1e-3
    assert np.abs(found.margin - expected.margin).mean() < 1e-3


def test_a_hidden_or_unrelated_source_does_no_harm():
    """The two best sources count."""
    noise = np.random.default_rng(0).random(IMAGES[0].shape, np.float32)
    sources = [*posed(IMAGES, 2, 0, 4), NeighbourView(noise, np.eye(4))]
    found = plane_sweep(CAMERA, IMAGES[2], sources, planes(48))
    assert np.median(relative_error(inverse_depth(found, planes(48)), 2)) < 0.015


def test_pixels_that_no_source_shows_have_no_plane():
    away = se3.exp([0, 0, 0, 0, np.pi, 0])
    found = plane_sweep(CAMERA, IMAGES[0], [NeighbourView(IMAGES[1], away)], planes(16))
    assert (found.plane == -1).all()


@pytest.mark.parametrize("name", [None, *available_instruction_sets()])
def test_doubled_depth_does_not_mix_surfaces(name, monkeypatch):
    use_kernels(monkeypatch, name)
    # A step in depth and intensity at column 21 of the full image, which is odd.
    intensity = np.where(np.arange(40) < 21, 0.2, 0.8)[None].repeat(30, 0).astype(np.float32)
    half_intensity = np.ascontiguousarray(intensity.reshape(15, 2, 20, 2).mean((1, 3)))
    half = np.where(np.arange(20) < 10, 0.5, 1.0)[None].repeat(15, 0).astype(np.float32)
    half[:4] = 0.0
    doubled = double_depth(half, half_intensity, intensity, 0.1)
    assert (doubled[:6] == 0).all()
    assert set(np.unique(doubled[12:])) == {np.float32(0.5), np.float32(1.0)}
    assert (doubled[12:, 22:] == 1.0).all()
    assert (doubled[12:, :20] == 0.5).all()


@pytest.mark.parametrize("name", [None, *available_instruction_sets()])
def test_doubled_depth_interpolates_a_surface(name, monkeypatch):
    use_kernels(monkeypatch, name)
    camera = Camera(100.0, 100.0, 30.0, 20.0, 61, 43)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    slanted = (0.5 + 0.002 * x + 0.001 * y).astype(np.float32)
    x, y = np.meshgrid(np.arange(camera.width // 2), np.arange(camera.height // 2))
    half = (0.5 + 0.002 * (2 * x + 0.5) + 0.001 * (2 * y + 0.5)).astype(np.float32)
    doubled = double_depth(half, np.zeros_like(half), np.zeros_like(slanted), 0.1)
    np.testing.assert_allclose(doubled[1:-2, 1:-2], slanted[1:-2, 1:-2], atol=1e-5)
    np.testing.assert_allclose(doubled, slanted, atol=0.005)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"planes": Planes(IMAGES[0][1:], 0.1, 8)}, "float32 of shape"),
        ({"intensity": IMAGES[0].astype(np.float64)}, "float32 of shape"),
        ({"intensity": IMAGES[0][:-1]}, "float32 of shape"),
        ({"camera": CAMERA.cropped(0, 0, 1, 60)}, "at least 2x2"),
    ],
)
def test_unusable_input_is_rejected(arguments, message):
    usual = {"camera": CAMERA, "intensity": IMAGES[0], "sources": posed(IMAGES, 0, 1)}
    with pytest.raises(ValueError, match=message):
        plane_sweep(**(usual | {"planes": planes(8)} | arguments))


def test_true_depth_is_within_the_range():
    """The other tests of this module rely on it."""
    assert TRUE[2].min() > 0.2
    assert TRUE[2].max() < 1.0 / NEAR * 1.6
