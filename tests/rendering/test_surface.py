"""Surface depth: native kernel against torch, and no bias on slanted walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from splat_scenes import Scene, random_scene
from torch import Tensor

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.options import SeedingOptions
from toolkit.splatting.gaussians.seeding import seed
from toolkit.splatting.rendering import RenderOptions, backend, render_surface, surface
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.reference import ReferenceBackend

CAMERA = Camera(fx=150.0, fy=150.0, cx=79.5, cy=59.5, width=160, height=120)


def fallback(images: Tensor, scene: Scene, min_silhouette: float) -> Tensor:
    return surface._surface_depth_torch(images, scene.camera, scene.T_camera_map, min_silhouette)


def moved(points: Tensor, T: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(se3.transform_points(T, points.numpy())).to(torch.float32)


def images_of(scene: Scene) -> Tensor:
    """Images [8, H, W] whose features are the centres."""
    means = scene.cloud.means
    return (
        ReferenceBackend()
        .forward(scene.cloud, scene.camera, scene.T_camera_map, means, None)
        .images
    )


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("count", [120, 400])  # with and almost without holes
def test_kernel_agrees_with_torch(
    native: NativeRenderer, monkeypatch: pytest.MonkeyPatch, number: int, count: int
) -> None:
    monkeypatch.setattr(surface, "kernels_for", lambda tensor: native._module)
    scene = random_scene(number, count=count)
    images = images_of(scene).contiguous()
    actual = surface.surface_depth(images, scene.camera, scene.T_camera_map, 0.5).double()
    exact = fallback(images.double(), scene, 0.5)
    assert torch.equal(actual > 0, exact > 0)
    # Some pixels are corrected by a plane, others keep the mean depth.
    corrected = (exact - images[3] / images[4].clamp(min=1e-6)).abs() > 1e-4
    assert 5 <= int((corrected & (exact > 0)).sum()) < 0.5 * exact.numel()
    # The results may differ for pixels at the thresholds of edges and planes.
    error = (actual - exact).abs() / exact.clamp(min=0.1)
    assert int((error > 1e-4).sum()) <= 2
    assert float(error.max()) <= 0.1


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (9, 2), (3, 3)])
def test_images_too_small_for_a_plane(
    native: NativeRenderer, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    monkeypatch.setattr(surface, "kernels_for", lambda tensor: native._module)
    scene = random_scene(3, count=200, size=size)
    images = images_of(scene).contiguous()
    actual = surface.surface_depth(images, scene.camera, scene.T_camera_map, 0.3)
    torch.testing.assert_close(actual, fallback(images, scene, 0.3), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("slope", [(0.8, 0.0), (0.0, -0.8), (0.6, 0.6)])
def test_depth_of_slanted_walls_is_unbiased(slope: tuple[float, float]) -> None:
    """On a wall seeded from one view the mean depth is too small, the surface depth is not."""
    rays = CAMERA.rays()
    # Intersection of each pixel's ray with the plane z = 2 + slope . (x, y).
    depth = (2.0 / (1.0 - rays[..., 0] * slope[0] - rays[..., 1] * slope[1])).astype(np.float32)
    frame = Frame(0, 0.0, np.full((120, 160, 3), 0.5, np.float32), depth, CAMERA)
    everywhere = np.ones_like(depth, dtype=bool)
    gaussians = seed(frame, np.eye(4), everywhere, SeedingOptions(max_cell=1))
    view = render_surface(backend(), gaussians, CAMERA, np.eye(4))
    at_two_metres = np.abs(depth - 2.0) < 0.3
    at_two_metres[:8] = at_two_metres[-8:] = False
    at_two_metres[:, :8] = at_two_metres[:, -8:] = False
    mean_error = (view.output.depth_m.numpy() - depth)[at_two_metres].mean()
    error = (view.depth_m.numpy() - depth)[at_two_metres].mean()
    assert abs(mean_error) > 1e-3
    assert abs(error) < 3e-4


@pytest.mark.parametrize("radius", [0.6, 1.2])
def test_depth_of_steep_walls_is_unbiased(radius: float) -> None:
    """At 75 degrees the Gaussians of a pixel are up to a tenth of its depth off the ray."""
    normal = np.array([np.sin(np.deg2rad(75.0)), 0.0, np.cos(np.deg2rad(75.0))])
    depth = 0.5 / np.maximum(CAMERA.rays() @ normal, 1e-9)
    depth = np.where(depth < 6.0, depth, 0.0).astype(np.float32)
    frame = Frame(0, 0.0, np.full((120, 160, 3), 0.5, np.float32), depth, CAMERA)
    options = SeedingOptions(radius=radius, max_cell=1)
    gaussians = seed(frame, np.eye(4), depth > 0, options)
    view = render_surface(backend(), gaussians, CAMERA, np.eye(4))
    error = abs(view.depth_m.numpy() - depth)
    inside = np.zeros_like(depth, dtype=bool)
    inside[8:-8, 8:-8] = (depth[8:-8, 8:-8] > 0) & (depth[8:-8, 8:-8] < 4.0)
    assert np.mean(error[inside] < 0.005 * depth[inside]) > 0.97


@pytest.mark.parametrize("centres", [[(0.1, -0.2)], [(-0.3, 0.0), (0.4, 0.1)]])
@pytest.mark.parametrize("way", ["kernel", "torch"])
def test_depth_of_few_wide_gaussians(
    native: NativeRenderer, monkeypatch: pytest.MonkeyPatch, way: str, centres: list
) -> None:
    """Their mean centre hardly changes between pixels; no normal is estimated from rounding."""
    monkeypatch.setattr(
        surface, "kernels_for", lambda tensor: native._module if way == "kernel" else None
    )
    count = len(centres)
    cloud = GaussianCloud.from_values(
        torch.tensor([[x, y, 2.0] for x, y in centres]),
        torch.full((count,), 0.3),
        torch.full((count,), 0.99),
        torch.full((count, 3), 0.5),
    )
    # A different origin, so that the centres are rounded in the camera's frame.
    T_camera_map = se3.exp(np.array([1.3, -0.7, 0.9, 0.4, 0.3, -0.6]))
    cloud = replace(cloud, means=moved(cloud.means, se3.inverse(T_camera_map)))
    view = render_surface(native, cloud, CAMERA, T_camera_map)
    solid = view.output.silhouette >= 0.5
    assert int(solid.sum()) > 300
    assert float((view.depth_m[solid] - 2.0).abs().max()) < 1e-4


def test_pixels_with_small_silhouette_have_no_surface() -> None:
    scene = random_scene(0, count=30)
    view = render_surface(
        backend(), scene.cloud, scene.camera, scene.T_camera_map, RenderOptions(0.5)
    )
    thin = view.output.silhouette < 0.5
    assert thin.any() and not thin.all()
    assert not view.depth_m[thin].any()
    assert (view.depth_m[~thin] > 0).all()
