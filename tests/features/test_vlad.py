"""VLAD of keypoints: invariances, and views of a place against others."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from places import place

from toolkit.semantics.features.encoder import Encoder
from toolkit.semantics.features.factory import build_differentiable_describer
from toolkit.semantics.features.options import FeatureOptions
from toolkit.semantics.features.vlad import VladEncoder, root_sift, vocabulary


@pytest.fixture(scope="module")
def vlad() -> Encoder:
    return VladEncoder()


def views_of(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Two crops [1, 3, 100, 130] of a picture that share three quarters of their width."""
    picture = torch.nn.functional.interpolate(place(seed)[None], scale_factor=2.0, mode="bilinear")
    return picture[..., :100, :130], picture[..., :100, 30:160]


def test_descriptors_are_reproducible_unit_vectors(vlad):
    images = torch.cat([views_of(seed)[0] for seed in range(3)])
    descriptors = vlad.describe(images)
    assert descriptors.shape == (3, vlad.dimensions) and descriptors.dtype == torch.float32
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(3))
    assert torch.equal(descriptors, vlad.describe(images.clone()))
    assert torch.equal(descriptors[1:2], vlad.describe(images[1:2]))


def test_overlapping_views_are_nearer_than_other_places(vlad):
    first = torch.cat([vlad.describe(views_of(seed)[0]) for seed in range(5)])
    second = torch.cat([vlad.describe(views_of(seed)[1]) for seed in range(5)])
    assert (first @ second.T).argmax(dim=1).tolist() == list(range(5))


def test_exposure_hardly_changes_a_descriptor(vlad):
    view, _ = views_of(0)
    darker, other = 0.6 * view + 0.05, views_of(1)[0]
    same, different = (vlad.describe(view) @ vlad.describe(v).T for v in (darker, other))
    assert same > 0.6 > different


@pytest.mark.parametrize("size", [(1, 1), (8, 300), (48, 64)])
def test_uniform_images_have_the_neutral_descriptor(vlad, size):
    blank = vlad.describe(torch.full((1, 3, *size), 0.5))[0]
    assert blank.norm().item() == pytest.approx(1.0, abs=1e-5)
    assert torch.all(blank == blank[0])


def test_a_word_is_described_by_what_differs_from_it():
    words = vocabulary()
    bytes_ = np.random.default_rng(0).integers(0, 120, (1, 128)).astype(np.uint8)
    vector = words.aggregate(bytes_).reshape(words.words.shape)
    (used,) = np.flatnonzero(np.linalg.norm(vector, axis=1))
    reduced = (root_sift(bytes_)[0] - words.mean) @ words.basis
    assert used == np.linalg.norm(words.words - reduced, axis=1).argmin()
    difference = reduced - words.words[used]
    np.testing.assert_allclose(vector[used], difference / np.linalg.norm(difference), atol=1e-5)


def test_losses_get_an_encoder_with_gradients():
    describer = build_differentiable_describer(FeatureOptions(kind="vlad"))
    image = views_of(0)[0].requires_grad_(True)
    describer.describe(image)[0, 0].backward()
    assert torch.isfinite(image.grad).all() and image.grad.abs().sum() > 0
