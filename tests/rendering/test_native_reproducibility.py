"""Reproducibility: results do not depend on threads, order of calls or region."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from splat_scenes import (
    Scene,
    assert_identical,
    assert_same_gradients,
    assert_same_images,
    exact,
    gradients_of,
    random_scene,
    reference_images,
)

from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import TILE, tile_counts
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.reference import ReferenceBackend


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def busy_scene(seed: int = 0) -> Scene:
    """Enough Gaussians and tiles for several chunks per parallel loop."""
    return random_scene(seed, count=12_000, channels=5, size=(200, 130))


def random_region(camera: Camera, seed: int = 3) -> torch.Tensor:
    return torch.rand(tile_counts(camera), generator=torch.Generator().manual_seed(seed)) < 0.4


@pytest.mark.parametrize("with_region", [False, True])
def test_threads_do_not_change_results(native: NativeRenderer, with_region: bool) -> None:
    scene = busy_scene()
    region = random_region(scene.camera) if with_region else None
    weights = torch.randn(10, 130, 200, generator=torch.Generator().manual_seed(1))
    torch.set_num_threads(1)
    images = scene.draw(native, region)
    gradients = gradients_of(scene, native, weights, region)
    torch.set_num_threads(2)
    for _ in range(3):
        assert torch.equal(scene.draw(native, region), images)
        assert_identical(gradients_of(scene, native, weights, region), gradients)


def test_results_do_not_depend_on_earlier_views(native: NativeRenderer) -> None:
    """Buffers are reused; the content of a larger earlier view must not affect the result."""
    scene = random_scene(1, channels=4)
    weights = scene.loss_weights()
    fresh, gradients = scene.draw(native), gradients_of(scene, native, weights)
    for other in (busy_scene(), random_scene(2, channels=0), random_scene(3, channels=9)):
        gradients_of(other, native, torch.ones_like(other.draw(native)))
        assert torch.equal(scene.draw(native), fresh)
        assert_identical(gradients_of(scene, native, weights), gradients)


def test_two_views_can_be_in_use_at_once(native: NativeRenderer) -> None:
    first, second = random_scene(1), random_scene(2)
    weights = first.loss_weights()
    expected = gradients_of(first, native, weights)["means"]
    drawn_first = first.forward(native)
    drawn_second = second.forward(native)
    drawn_second.backward(weights)
    gradients = drawn_first.backward(weights)
    assert torch.equal(gradients.means, expected[gradients.ids])


def test_rendering_from_several_threads(native: NativeRenderer) -> None:
    scenes = [random_scene(k, channels=3) for k in range(4)] * 8
    weights = scenes[0].loss_weights()
    expected = [gradients_of(s, native, weights) for s in scenes[:4]]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda s: gradients_of(s, native, weights), scenes))
    finally:
        sys.setswitchinterval(interval)
    for k, gradients in enumerate(results):
        assert_identical(gradients, expected[k % 4])


@pytest.mark.parametrize("channels", [0, 5])
def test_tiles_of_a_region_are_identical(native: NativeRenderer, channels: int) -> None:
    scene = random_scene(8, count=300, channels=channels, size=(75, 61))
    region = random_region(scene.camera)
    drawn = pixels_of(region, scene.camera)
    full, part = scene.draw(native), scene.draw(native, region)
    assert torch.equal(part, full * drawn)
    assert drawn.any()
    assert not drawn.all()


@pytest.mark.parametrize("channels", [0, 5])
def test_gradients_of_a_region_are_those_of_its_loss(native: NativeRenderer, channels: int) -> None:
    scene = random_scene(8, count=300, channels=channels, size=(75, 61))
    region = random_region(scene.camera)
    weights = scene.loss_weights() * pixels_of(region, scene.camera)
    assert_identical(
        gradients_of(scene, native, weights, region), gradients_of(scene, native, weights)
    )


def test_region_ignores_the_loss_outside(native: NativeRenderer) -> None:
    scene = random_scene(8, count=100, size=(75, 61))
    region = random_region(scene.camera)
    weights = scene.loss_weights()
    inside = weights * pixels_of(region, scene.camera)
    assert_identical(
        gradients_of(scene, native, weights, region), gradients_of(scene, native, inside, region)
    )


def test_region_agrees_with_the_reference(native: NativeRenderer) -> None:
    scene = random_scene(8, count=100, size=(75, 61))
    region = random_region(scene.camera)
    weights = scene.loss_weights() * pixels_of(region, scene.camera)
    assert_same_images(scene.draw(native, region), scene, reference_images(scene, region))
    expected = gradients_of(exact(scene), ReferenceBackend(), weights, region)
    assert_same_gradients(gradients_of(scene, native, weights, region), expected)


def test_empty_region_renders_zero(native: NativeRenderer) -> None:
    scene = random_scene(8)
    region = torch.zeros(tile_counts(scene.camera), dtype=torch.bool)
    assert not scene.draw(native, region).any()
    gradients = gradients_of(scene, native, scene.loss_weights(), region)
    assert not any(g.any() for g in gradients.values())


def test_a_million_gaussians(native: NativeRenderer) -> None:
    rng = torch.Generator().manual_seed(0)
    count = 1_000_000
    means = torch.rand(count, 3, generator=rng) * torch.tensor([3.2, 2.4, 2.0])
    cloud = GaussianCloud.from_values(
        means + torch.tensor([-1.6, -1.2, 1.5]),
        torch.full((count,), 0.004),
        torch.full((count,), 0.5),
        torch.rand(count, 3, generator=rng),
    )
    scene = Scene(cloud, Camera(290, 290, 159.5, 119.5, 320, 240), np.eye(4))
    drawn = scene.forward(native)
    assert torch.isfinite(drawn.images).all()
    assert float(drawn.images[4].mean()) > 0.9
    gradients = drawn.backward(torch.ones_like(drawn.images))
    assert len(gradients.ids) > 500_000
    assert torch.isfinite(gradients.means).all()
    assert torch.isfinite(gradients.T_camera_map).all()


def pixels_of(region: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Mask [H, W] of the region's pixels."""
    spread = region.repeat_interleave(TILE, dim=0).repeat_interleave(TILE, dim=1)
    return spread[: camera.height, : camera.width]
