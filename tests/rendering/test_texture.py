"""Colours are located at the Gaussians' mean centres, not at the pixel centres."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, SurfaceView, backend, render_surface, texture
from toolkit.splatting.rendering.texture import (
    centre_offsets,
    centred_intensity,
    resample_at_centres,
    shift_to_centres,
)

CAMERA = Camera(60.0, 58.0, 31.5, 23.5, 64, 48)
LUMA = torch.tensor([0.299, 0.587, 0.114])


def slanted_wall(slope: float) -> tuple[GaussianCloud, torch.Tensor]:
    """A wall z = 2 + slope x, seeded at the pixels' rays, and its image [3, 48, 64].

    Colours are linear in the place on the wall: what is drawn of overlapping Gaussians is then
    the colour of their mean centre, times the silhouette.
    """
    rays = CAMERA.rays().reshape(-1, 3)
    points = rays * (2.0 / (1.0 - slope * rays[:, 0]))[:, None]
    colours = 0.5 + points[:, :1] * [0.2, 0.1, -0.1] + points[:, 1:2] * [0.1, -0.2, 0.1]
    count = len(points)
    cloud = GaussianCloud(
        torch.from_numpy(points).float(),
        torch.from_numpy(np.log(0.6 * points[:, 2] / CAMERA.fx)).float(),
        torch.full((count,), 3.0),
        torch.from_numpy(colours).float(),
        torch.zeros(count, 0),
    )
    image = torch.from_numpy(colours.reshape(48, 64, 3).transpose(2, 0, 1).copy()).float()
    return cloud, image


def drawn(cloud: GaussianCloud, T: np.ndarray | None = None) -> SurfaceView:
    T = np.eye(4) if T is None else T
    return render_surface(backend("native"), cloud, CAMERA, T, RenderOptions(0.9))


def inner(image: torch.Tensor) -> torch.Tensor:
    return image[..., 6:-6, 6:-6]


@pytest.mark.parametrize("slope", [-0.8, 0.8])
def test_rendered_colour_is_that_of_the_mean_centre(slope):
    cloud, image = slanted_wall(slope)
    view = drawn(cloud)
    shown = view.images[:3] / view.images[4]
    nearer = float(inner(centre_offsets(view, 0.9)[0]).mean())
    assert abs(nearer) > 0.2 and np.sign(nearer) == -np.sign(slope)
    beside = inner(shown - image).abs().mean()
    there = inner(shown - resample_at_centres(image, view, 0.9)).abs().mean()
    assert float(there) < 0.1 * float(beside)


def test_intensities_are_shifted_to_the_mean_centres():
    cloud, image = slanted_wall(0.8)
    view = drawn(cloud)
    true = torch.einsum("c,cyx->yx", LUMA, image)
    shown = torch.einsum("c,cyx->yx", LUMA, view.images[:3] / view.images[4])
    moved = shift_to_centres(shown, view, 0.9)
    assert float(inner(moved - true).abs().mean()) < 0.1 * float(inner(shown - true).abs().mean())


@pytest.fixture
def wavy() -> tuple[SurfaceView, torch.Tensor]:
    """A view with holes, edges and translucent areas, and an image of noise."""
    cloud, _ = slanted_wall(0.5)
    generator = torch.Generator().manual_seed(0)
    cloud.means[:, 2] += 0.05 * torch.rand(len(cloud), generator=generator)
    kept = torch.rand(len(cloud), generator=generator) > 0.2
    pose = se3.exp(np.array([0.05, -0.03, 0.04, 0.02, 0.1, -0.03]))
    return drawn(cloud.select(kept), pose), torch.rand(3, 48, 64, generator=generator)


@pytest.mark.parametrize("instructions", available_instruction_sets())
def test_native_kernels_agree_with_torch(wavy, monkeypatch, instructions):
    view, image = wavy
    monkeypatch.setattr(texture, "kernels_for", lambda _: None)
    sampled = resample_at_centres(image, view, 0.8)
    luma = torch.einsum("c,cyx->yx", LUMA, view.images[:3])
    luma = torch.where(view.images[4] >= 0.8, luma, torch.zeros_like(luma))
    moved = shift_to_centres(luma, view, 0.8)
    assert centred_intensity(view, 0.8) is None
    monkeypatch.setattr(texture, "kernels_for", lambda _: load_variant(instructions))
    assert float((sampled - image).abs().max()) > 0.1 and float((moved - luma).abs().max()) > 1e-3
    assert torch.allclose(resample_at_centres(image, view, 0.8), sampled, atol=1e-4)
    assert torch.allclose(centred_intensity(view, 0.8), moved, atol=1e-5)


def test_translucent_pixels_are_not_shifted(wavy):
    view, image = wavy
    offsets = centre_offsets(view, 0.8)
    thin = view.images[4] < 0.8
    assert bool(thin.any()) and bool((offsets[:, thin] == 0).all())
    assert torch.equal(resample_at_centres(image, view, 2.0), image)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 2)])
def test_images_of_a_few_pixels(size):
    height, width = size
    camera = Camera(5.0, 5.0, 0.0, 0.0, width, height)
    cloud, _ = slanted_wall(0.3)
    view = render_surface(backend("native"), cloud, camera, np.eye(4), RenderOptions(0.5))
    image = torch.rand(3, height, width)
    assert resample_at_centres(image, view).shape == image.shape
    assert centred_intensity(view, 0.5).shape == (height, width)
    assert texture._sampled(image, centre_offsets(view, 0.5)).shape == image.shape
