"""From pixels to Gaussians: how many, where, how large, in which cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.options import SeedingOptions
from toolkit.splatting.gaussians.seeding import seed

CAMERA = Camera(300.0, 310.0, 15.0, 11.0, 32, 24)
SINGLE, CELLS, LARGE = (SeedingOptions(max_cell=n) for n in (1, 2, 4))
POSE = se3.exp(np.array([0.5, -0.3, 0.2, 0.3, -0.2, 0.4]))


def plain_wall(camera: Camera = CAMERA, depth_m: float = 2.0) -> Frame:
    shape = (camera.height, camera.width)
    rgb = np.full((*shape, 3), 0.4, dtype=np.float32)
    return Frame(0, 0.0, rgb, np.full(shape, depth_m, dtype=np.float32), camera)


def noisy_wall() -> Frame:
    frame = plain_wall()
    rgb = np.random.default_rng(0).random(frame.rgb.shape, dtype=np.float32)
    return replace(frame, rgb=rgb)


def everywhere(frame: Frame) -> np.ndarray:
    return np.ones(frame.depth_m.shape, dtype=bool)


@pytest.mark.parametrize(("options", "count"), [(SINGLE, 768), (CELLS, 192), (LARGE, 48)])
def test_plain_surfaces_get_one_gaussian_a_cell(options, count):
    frame = plain_wall()
    assert len(seed(frame, POSE, everywhere(frame), options)) == count


def test_cells_are_at_most_a_fraction_of_the_focal_length_wide():
    frame = plain_wall(replace(CAMERA, fx=120.0, fy=120.0))
    assert len(seed(frame, POSE, everywhere(frame), LARGE)) == 192


def test_texture_within_the_noise_is_flat():
    frame = plain_wall()
    frame.rgb[::2] += np.float32(0.08)
    assert len(seed(frame, POSE, everywhere(frame), LARGE)) == 768
    assert len(seed(frame, POSE, everywhere(frame), LARGE, noise=0.03)) == 192
    assert len(seed(frame, POSE, everywhere(frame), LARGE, noise=0.04)) == 48
    # The pixels of a camera of less than half the resolution are twice as far apart.
    coarse = replace(frame, camera=replace(CAMERA, fx=120.0, fy=120.0))
    assert len(seed(coarse, POSE, everywhere(coarse), LARGE, noise=0.04)) == 768


def test_strong_texture_is_not_flat_at_any_noise():
    frame = noisy_wall()
    assert len(seed(frame, POSE, everywhere(frame), LARGE, noise=1.0)) > 700


@pytest.mark.parametrize("options", [SINGLE, CELLS, LARGE])
def test_textured_surfaces_get_one_a_pixel(options):
    frame = noisy_wall()
    assert len(seed(frame, POSE, everywhere(frame), options)) == 768


def test_edges_in_depth_get_one_a_pixel():
    frame = plain_wall()
    frame.depth_m[:, 17:] = 3.0  # the edge lies within the cells of columns 16 and 17
    cloud = seed(frame, POSE, everywhere(frame), CELLS)
    assert len(cloud) == 15 * 12 + 2 * 24


def test_only_masked_pixels_with_depth_become_gaussians():
    frame = noisy_wall()
    mask = everywhere(frame)
    mask[:10] = False
    frame.depth_m[20:, :5] = 0.0
    assert len(seed(frame, POSE, mask, CELLS)) == 14 * 32 - 4 * 5


def test_nothing_wanted_is_an_empty_cloud():
    frame = plain_wall()
    assert len(seed(frame, POSE, ~everywhere(frame), LARGE)) == 0


@pytest.mark.parametrize("size", [(33, 25), (1, 1), (3, 2)])
def test_odd_images_are_covered_to_the_border(size):
    camera = replace(CAMERA, width=size[0], height=size[1])
    frame = plain_wall(camera)
    cloud = seed(frame, POSE, everywhere(frame), CELLS)
    cells = (size[0] // 2) * (size[1] // 2)
    assert 4 * cells + (len(cloud) - cells) == size[0] * size[1]


@pytest.mark.parametrize("options", [SINGLE, CELLS, LARGE])
def test_seeds_lie_on_the_surface_they_were_seen_on(options):
    """A slanted wall: also the centre of a large cell lies on it."""
    normal, distance = np.array([0.1, -0.05, 1.0]), 2.0
    depth = (distance / (CAMERA.rays() @ normal)).astype(np.float32)
    frame = replace(plain_wall(), depth_m=depth)
    cloud = seed(frame, POSE, everywhere(frame), options)
    points = se3.transform_points(se3.inverse(POSE), cloud.means.double().numpy())
    assert abs(points @ normal - distance).max() < 1e-5


def test_pixels_and_seeds_coincide():
    frame = noisy_wall()
    cloud = seed(frame, POSE, everywhere(frame), SINGLE)
    points = se3.transform_points(se3.inverse(POSE), cloud.means.double().numpy())
    u, v = np.rint(CAMERA.project(points)).astype(int).T
    assert np.allclose(CAMERA.project(points), np.stack([u, v], 1), atol=1e-3)
    assert np.allclose(cloud.colours.numpy(), frame.rgb[v, u])


@pytest.mark.parametrize(("options", "cell"), [(SINGLE, 1), (CELLS, 2), (LARGE, 4)])
def test_radius_is_the_footprint_of_the_cell(options, cell):
    frame = plain_wall(depth_m=3.0)
    cloud = seed(frame, POSE, everywhere(frame), options)
    expected = options.radius * cell * 3.0 / CAMERA.focal
    assert torch.allclose(cloud.radii_m, torch.tensor(expected), rtol=1e-5)
    assert torch.allclose(cloud.opacities, torch.tensor(options.opacity), rtol=1e-5)


def test_features_follow_their_pixels():
    frame = noisy_wall()
    v, u = np.mgrid[:24, :32]
    frame = replace(frame, labels=(32 * v + u).astype(np.int32))
    by_class = torch.from_numpy(np.stack([u.ravel(), v.ravel()], -1).astype(np.float32))
    cloud = seed(frame, np.eye(4), everywhere(frame), SINGLE, by_class)
    uv = CAMERA.project(cloud.means.double().numpy())
    assert np.allclose(cloud.features.numpy(), uv, atol=1e-3)


def test_a_cell_does_not_span_two_classes():
    frame = plain_wall()
    labels = np.ones(frame.depth_m.shape, np.int32)
    labels[:, 17:] = 2  # the border lies within the cells of columns 16 and 17
    frame = replace(frame, labels=labels)
    by_class = torch.tensor([[0.0], [1.0], [2.0]])
    cloud = seed(frame, np.eye(4), everywhere(frame), CELLS, by_class)
    assert len(cloud) == 15 * 12 + 2 * 24
    right = CAMERA.project(cloud.means.double().numpy())[:, 0] > 16.5
    assert torch.equal(cloud.features[:, 0], torch.from_numpy(1.0 + right).float())


def two_classes() -> Frame:
    labels = np.ones((24, 32), np.int32)
    labels[:4, :4] = 2
    return replace(noisy_wall(), labels=labels)


@pytest.mark.parametrize("choice", ["uniform", "semantic"])
def test_a_random_share_seeds_larger_gaussians(choice):
    """As many as asked for, and together they cover the same area."""
    options = SeedingOptions(choice=choice, share=0.25)
    frame = two_classes()
    generator = np.random.default_rng(0)
    cloud = seed(frame, np.eye(4), everywhere(frame), options, None, generator)
    every = seed(frame, np.eye(4), everywhere(frame), SINGLE)
    assert len(cloud) == 192
    assert float((cloud.radii_m**2).sum()) == pytest.approx(
        float((every.radii_m**2).sum()), rel=1e-4
    )


def test_semantic_choice_favours_small_classes():
    by_class = torch.tensor([[0.0], [1.0], [2.0]])
    small = {}
    for choice in ("uniform", "semantic"):
        options = SeedingOptions(choice=choice, share=0.1)
        cloud = seed(
            two_classes(),
            np.eye(4),
            everywhere(two_classes()),
            options,
            by_class,
            np.random.default_rng(0),
        )
        small[choice] = int((cloud.features[:, 0] == 2).sum())
    # sqrt(16) : sqrt(752) of 77 pixels, against 16 : 752.
    assert small["semantic"] == 10
    assert small["uniform"] < 6
