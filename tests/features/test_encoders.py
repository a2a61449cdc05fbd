"""Encoders: properties of all encoders, and discrimination of the built-in one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from places import place

from toolkit.semantics.features.builtin import BuiltinEncoder, ColourHistogramEncoder


def test_descriptors_are_unit_vectors_of_the_stated_dimension(encoder, views):
    descriptors = encoder.describe(views)
    assert descriptors.shape == (len(views), encoder.dimensions)
    assert descriptors.dtype == torch.float32
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(len(views)))
    assert 0.0 < encoder.threshold < 2.0


def test_descriptors_are_reproducible(encoder, views):
    assert torch.equal(encoder.describe(views), encoder.describe(views.clone()))


def test_descriptors_do_not_depend_on_the_batch(encoder, views):
    torch.testing.assert_close(encoder.describe(views[2:3])[0], encoder.describe(views)[2])


@pytest.mark.parametrize("size", [(24, 32), (75, 100), (120, 160), (48, 200)])
def test_images_of_any_size_are_accepted(encoder, size):
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    assert torch.isfinite(encoder.describe(image)).all()


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_uniform_image_has_finite_descriptor_and_gradient(encoder, level):
    image = torch.full((1, 3, 40, 48), level, requires_grad=True)
    descriptor = encoder.describe(image)
    descriptor[0, 0].backward()
    assert descriptor.norm().item() == pytest.approx(1.0, abs=1e-5)
    assert torch.isfinite(image.grad).all()


def test_gradient_agrees_with_finite_differences(encoder, views):
    # Random directions in image and descriptor space, compared with a finite difference.
    generator = torch.Generator().manual_seed(1)
    noise = 0.05 * torch.randn(views[:1].shape, generator=generator)  # avoids discontinuities
    image = (views[:1] + noise).requires_grad_(True)
    aside = torch.randn(encoder.dimensions, generator=generator)
    step = torch.randn(image.shape, generator=generator)
    step /= step.norm()
    (encoder.describe(image)[0] * aside).sum().backward()
    predicted = float((image.grad * step).sum())
    h = 2e-2

    def value(t: float) -> float:
        return float((encoder.describe(image.detach() + t * step)[0].double() * aside).sum())

    assert predicted == pytest.approx((value(h) - value(-h)) / (2 * h), rel=0.1, abs=2e-3)


def test_gradient_descent_reduces_the_distance(encoder, views):
    target = encoder.describe(views[1:2])
    image = views[:1].clone().requires_grad_(True)
    before = (encoder.describe(image) - target.detach()).square().sum()
    before.backward()
    after = encoder.describe(image.detach() - 0.5 * image.grad / image.grad.norm()) - target
    assert after.square().sum() < before.detach()


@pytest.mark.parametrize("shape", [(3, 40, 40), (1, 4, 40, 40), (1, 40, 40, 3)])
def test_other_shapes_raise(encoder, shape):
    with pytest.raises(ValueError, match=r"shape \[B, 3, H, W\]"):
        encoder.describe(torch.zeros(shape))
    with pytest.raises(ValueError, match="floats"):
        encoder.describe(torch.zeros((1, 3, 40, 40), dtype=torch.uint8))


@settings(max_examples=25)
@given(gain=st.floats(0.15, 1.3), bias=st.floats(-0.05, 0.1), seed=st.integers(0, 100))
def test_builtin_encoder_is_invariant_to_exposure(gain, bias, seed):
    view = 0.1 + 0.6 * place(seed)[None]
    distance = _distances(BuiltinEncoder(), view, gain * view + bias)
    assert distance.item() < 0.02


def test_white_balance_changes_the_descriptor_less_than_another_place():
    encoder = BuiltinEncoder()
    tinted = place(0)[None] * torch.tensor([1.05, 1.0, 0.95]).view(1, 3, 1, 1)
    distance = _distances(encoder, place(0)[None], tinted)
    assert distance.item() < encoder.threshold


def test_shifted_view_is_closer_than_any_other_place():
    encoder = BuiltinEncoder()
    left = torch.stack([place(seed)[:, :, :80] for seed in range(12)])
    # An eighth of the image, about eight degrees.
    right = torch.stack([place(seed)[:, :, 10:90] for seed in range(12)])
    distances = _distances(encoder, left, right)
    assert torch.equal(distances.argmin(dim=1), torch.arange(12))
    others = distances[~torch.eye(12, dtype=torch.bool)]
    assert distances.diagonal().max() < others.min()


def test_builtin_encoder_discriminates_mirrored_and_swapped_places():
    view = place(3)[None]
    mirrored = view.flip(3)
    assert _distances(ColourHistogramEncoder(), view, mirrored).item() < 1e-3
    assert _distances(BuiltinEncoder(), view, mirrored).item() > BuiltinEncoder.threshold / 2


def test_colour_discriminates_places_with_equal_edges():
    view = place(4)[None]
    swapped = view[:, [2, 1, 0]]
    assert _distances(BuiltinEncoder(), view, swapped).item() > BuiltinEncoder.threshold


def test_edge_orientation_discriminates_places():
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    descriptors = []
    for angle in (0.0, 45.0, 90.0, 135.0):
        along = x * np.cos(np.radians(angle)) + y * np.sin(np.radians(angle))
        descriptors.append((0.5 + 0.3 * torch.sin(along / 3.0)).expand(1, 3, -1, -1))
    distances = _distances(BuiltinEncoder(), torch.cat(descriptors), torch.cat(descriptors))
    assert distances[~torch.eye(4, dtype=torch.bool)].min() > BuiltinEncoder.threshold


def test_lightness_discriminates_places_with_equal_edges_and_hues():
    grey = place(6).mean(dim=0).expand(1, 3, -1, -1)
    assert _distances(BuiltinEncoder(), grey, 1.0 - grey).item() > BuiltinEncoder.threshold


def test_histogram_of_known_colours():
    red, half = torch.zeros(1, 3, 60, 80), torch.zeros(1, 3, 60, 80)
    red[:, 0], half[:, 0, :, :40] = 1.0, 1.0
    shares = ColourHistogramEncoder().describe(torch.cat([red, half])).square().view(2, 8, 8, 6)
    assert shares[0, 7, 0, 0].item() > 0.95
    np.testing.assert_allclose(shares[1, [0, 7], 0, 0] / shares[0, 7, 0, 0], 0.5, atol=1e-3)


def _distances(encoder, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    return torch.cdist(encoder.describe(one), encoder.describe(other))
