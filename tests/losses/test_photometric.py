"""SSIM and the mapping loss: values, derivatives, masks, with and without kernels."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from toolkit.base.geometry.camera import Camera
from toolkit.splatting.losses.options import RgbdLossWeights
from toolkit.splatting.losses.photometric import mean_ssim, rgbd_loss, ssim_torch
from toolkit.splatting.rendering import SurfaceView

PLACE = Camera(40.0, 41.0, 20.0, 17.0, 45, 37), np.eye(4)  # of a view; the losses use neither
SIZES = [(37, 45), (16, 16), (11, 64), (5, 3), (1, 1)]
SSIM_ONLY = replace(RgbdLossWeights(), colour=1.0, depth=0.0, silhouette=0.0, structure=1.0)


def drawn(height: int, width: int, channels: int = 0, seed: int = 0) -> Tensor:
    """Images [5 + S, H, W] of a partly translucent map."""
    images = torch.rand(5 + channels, height, width, generator=torch.Generator().manual_seed(seed))
    silhouette = 0.3 + 0.7 * images[4]
    depth = 1.0 + images[3]
    images[3], images[4] = depth * silhouette, silhouette
    return images


def seen(images: Tensor) -> SurfaceView:
    """A rendered view with holes, whose surface depth differs from the mean depth by up to 1 %."""
    mean = images[3] / images[4].clamp(min=0.1)
    generator = torch.Generator().manual_seed(5)
    surface = mean * (1 + 0.01 * torch.rand(mean.shape, generator=generator))
    surface[torch.rand(mean.shape, generator=generator) < 0.1] = 0.0
    return SurfaceView(SimpleNamespace(images=images), surface, *PLACE)


def observed(height: int, width: int, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Colour and depth similar to the rendered ones, with holes in the depth."""
    images = drawn(height, width)
    generator = torch.Generator().manual_seed(seed)
    rgb = (images[:3] + 0.1 * torch.randn(3, height, width, generator=generator)).clamp(0, 1)
    depth = images[3] / images[4] * (1 + 0.02 * torch.randn(height, width, generator=generator))
    depth[torch.rand(height, width, generator=generator) < 0.2] = 0.0
    return rgb, depth


def restated(view: SurfaceView, rgb: Tensor, depth_m: Tensor, weights: RgbdLossWeights) -> Tensor:
    """The loss as documented, computed per pixel in float64."""
    images, surface = view.images, view.depth_m

    def soft(error: Tensor, scale: Tensor | float) -> Tensor:
        return scale * (torch.sqrt(1 + (error / scale) ** 2) - 1)

    colour, depth_sum, silhouette = images[:3], images[3], images[4]
    flat = soft(colour - rgb, weights.colour_scale).mean()
    value = weights.colour * (1 - weights.structure) * flat
    if weights.structure:
        value = value + weights.colour * weights.structure * (1 - ssim_torch(colour, rgb))
    measured = depth_m > 0
    solid = measured & (surface > 0) & (silhouette > weights.min_silhouette)
    scale = weights.depth_scale_m * depth_m[solid].square().clamp(min=0.25)
    mean = depth_sum[solid] / silhouette[solid]
    error = mean + (surface[solid] - mean).detach() - depth_m[solid]
    value = value + weights.depth * soft(error, scale).sum() / depth_m.numel()
    return value + weights.silhouette * (1 - silhouette[measured]).sum() / depth_m.numel()


def assert_close(actual: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    """Assert equality relative to the largest entry."""
    scale = float(expected.abs().max()) + 1e-12
    assert float((actual.double() - expected.double()).abs().max()) <= tolerance * scale


class TestSsim:
    """SSIM alone."""

    @pytest.mark.parametrize("size", SIZES)
    def test_value_and_gradient_are_those_of_convolutions(self, kernels, size):
        images, (rgb, depth) = drawn(*size), observed(*size)
        leaf = images.double().requires_grad_()
        expected = 1.0 - ssim_torch(leaf[:3], rgb.double())
        (gradient,) = torch.autograd.grad(expected, leaf)
        value, actual = rgbd_loss(seen(images), rgb, depth, SSIM_ONLY)
        assert value == pytest.approx(float(expected.detach()), abs=2e-5)
        assert_close(actual / depth.numel(), gradient, 1e-3)

    def test_the_reference_is_torchmetrics(self):
        """Excludes the border, where torchmetrics pads by reflection."""
        images, (rgb, _) = drawn(40, 52), observed(40, 52)
        expected = structural_similarity_index_measure(
            images[None, :3], rgb[None], data_range=1.0, return_full_image=True
        )[1]
        inner = (slice(None), slice(10, -10), slice(10, -10))
        x = images[:3].double()
        whole = ssim_map(x, rgb.double())
        assert torch.allclose(whole[inner], expected[0][inner].double(), atol=1e-4)
        assert float(ssim_torch(x, rgb.double())) == pytest.approx(float(whole.mean()))

    def test_equal_images_have_similarity_one(self, kernels):
        rgb, depth = observed(24, 31)
        images = torch.cat([rgb, torch.ones(2, 24, 31)])
        value, gradient = rgbd_loss(seen(images), rgb, depth, SSIM_ONLY)
        assert value == pytest.approx(0.0, abs=1e-5)
        assert float(gradient.abs().max()) < 1e-2

    def test_flat_images_have_finite_gradients(self, kernels):
        images, rgb = torch.zeros(5, 20, 20), torch.zeros(3, 20, 20)
        value, gradient = rgbd_loss(seen(images), rgb, torch.zeros(20, 20), SSIM_ONLY)
        assert np.isfinite(value) and bool(torch.isfinite(gradient).all())


def ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """SSIM [C, H, W] of every pixel, by explicit windows with zero padding."""
    offsets = torch.arange(11, dtype=x.dtype) - 5
    line = torch.exp(-0.5 * (offsets / 1.5) ** 2)
    window = torch.outer(line, line) / line.sum() ** 2

    def mean(image: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(image, (5, 5, 5, 5))
        patches = padded.unfold(1, 11, 1).unfold(2, 11, 1)
        return (patches * window).sum(dim=(-1, -2))

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    return ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))


class TestRgbdLoss:
    """The whole mapping loss."""

    @pytest.mark.parametrize("size", SIZES)
    @pytest.mark.parametrize("structure", [0.0, 0.2])
    def test_value_and_gradient_are_as_documented(self, kernels, size, structure):
        weights = replace(RgbdLossWeights(), structure=structure)
        images, (rgb, depth) = drawn(*size), observed(*size)
        leaf = images.double().requires_grad_()
        exact = SurfaceView(SimpleNamespace(images=leaf), seen(images).depth_m.double(), *PLACE)
        expected = restated(exact, rgb.double(), depth.double(), weights)
        (gradient,) = torch.autograd.grad(expected, leaf)
        value, actual = rgbd_loss(seen(images), rgb, depth, weights)
        assert value == pytest.approx(float(expected.detach()), rel=1e-4, abs=1e-6)
        assert_close(actual / depth.numel(), gradient, 1e-3)

    @pytest.mark.parametrize("channel", range(5))
    def test_gradient_by_finite_differences(self, kernels, channel):
        """The gradient agrees with a finite difference in a random direction."""
        images, (rgb, depth) = drawn(20, 24), observed(20, 24)
        _, gradient = rgbd_loss(seen(images), rgb, depth, RgbdLossWeights())
        direction = torch.zeros_like(images)
        away = (images[4] - RgbdLossWeights().min_silhouette).abs() > 0.02
        direction[channel] = gradient[channel].sign() * away
        step = 1e-3
        surface, mean = seen(images).depth_m, images[3] / images[4]

        def value(moved: Tensor) -> float:
            # The surface depth changes with the mean depth.
            shifted = torch.where(surface > 0, surface + moved[3] / moved[4] - mean, surface)
            view = SurfaceView(SimpleNamespace(images=moved), shifted, *PLACE)
            return rgbd_loss(view, rgb, depth, RgbdLossWeights())[0]

        ahead, behind = value(images + step * direction), value(images - step * direction)
        predicted = float((gradient * direction).sum()) / depth.numel()
        assert (ahead - behind) / (2 * step) == pytest.approx(predicted, rel=0.03)

    def test_holes_in_the_depth_pull_at_no_depth(self, kernels):
        images, (rgb, depth) = drawn(20, 24), observed(20, 24)
        _, gradient = rgbd_loss(seen(images), rgb, depth, RgbdLossWeights())
        holes = depth == 0
        assert int(holes.sum()) > 50
        assert not gradient[3:5, holes].any()
        assert gradient[:3, holes].any(), "colour counts there"

    def test_depth_does_not_count_where_the_map_is_thin(self, kernels):
        images, (rgb, depth) = drawn(20, 24), observed(20, 24)
        weights = replace(RgbdLossWeights(), min_silhouette=0.7)
        _, gradient = rgbd_loss(seen(images), rgb, depth, weights)
        thin = images[4] < 0.69
        assert int(thin.sum()) > 50
        assert not gradient[3, thin].any()
        assert gradient[3, (images[4] > 0.71) & (depth > 0)].any()

    def test_features_have_no_part_in_it(self, kernels):
        images, (rgb, depth) = drawn(20, 24, channels=3), observed(20, 24)
        value, gradient = rgbd_loss(seen(images), rgb, depth, RgbdLossWeights())
        plain, base = rgbd_loss(seen(images[:5].contiguous()), rgb, depth, RgbdLossWeights())
        assert value == plain
        assert gradient.shape == (5, 20, 24) and torch.equal(gradient, base)

    def test_pixels_without_a_surface_pull_at_no_depth(self, kernels):
        images, (rgb, depth) = drawn(20, 24), observed(20, 24)
        view = seen(images)
        _, gradient = rgbd_loss(view, rgb, depth, RgbdLossWeights())
        assert int((view.depth_m == 0).sum()) > 20
        assert not gradient[3, view.depth_m == 0].any()

    def test_an_empty_view_is_no_error(self, kernels):
        rgb, depth = observed(20, 24)
        value, gradient = rgbd_loss(seen(torch.zeros(5, 20, 24)), rgb, depth, RgbdLossWeights())
        assert np.isfinite(value) and bool(torch.isfinite(gradient).all())

    def test_the_inputs_stay_as_they_are(self, kernels):
        images, (rgb, depth) = drawn(20, 24), observed(20, 24)
        copies = images.clone(), rgb.clone(), depth.clone()
        rgbd_loss(seen(images), rgb, depth, RgbdLossWeights())
        for before, after in zip(copies, (images, rgb, depth), strict=True):
            assert torch.equal(before, after)


def test_result_does_not_depend_on_the_number_of_threads(kernels):
    if kernels == "torch":
        return  # guaranteed by the native kernels only
    images, (rgb, depth) = drawn(120, 160), observed(120, 160)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one, by_one = rgbd_loss(seen(images), rgb, depth, RgbdLossWeights())
        torch.set_num_threads(2)
        many, by_many = rgbd_loss(seen(images), rgb, depth, RgbdLossWeights())
    finally:
        torch.set_num_threads(before)
    assert one == many and torch.equal(by_one, by_many)


@pytest.mark.parametrize("size", SIZES)
def test_mean_ssim_agrees_with_the_convolutions(size):
    x, y = drawn(*size)[:3], drawn(*size, seed=3)[:3]
    gradients, values = [], []
    for similarity in (mean_ssim, ssim_torch):
        leaf = x.clone().requires_grad_()
        value = 3.0 * similarity(leaf, y)
        gradients += torch.autograd.grad(value, leaf)
        values.append(float(value.detach()))
    assert values[0] == pytest.approx(values[1], abs=1e-5)
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-6)
