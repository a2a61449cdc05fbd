"""Semantic loss: kernel against autograd, void, schedule and inter-level term."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.semantics.codes import ColourCode, binary_code, flat_code, one_hot_code
from toolkit.semantics.decoder import NetworkDecoder
from toolkit.semantics.factory import build_code
from toolkit.semantics.options import (
    CodeOptions,
    NetworkOptions,
    SemanticLossWeights,
    SemanticsOptions,
)
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import build_semantic_mapping
from toolkit.splatting.losses import semantic
from toolkit.splatting.losses.photometric import ssim_torch
from toolkit.splatting.losses.semantic import SemanticLoss, semantic_loss_torch

TREE = Taxonomy(
    {
        "large": {"soft": ["bed", "sofa", "mattress"], "hard": ["table", "desk"]},
        "small": {"round": ["cup", "plate", "vase"], "phone": {}},
    }
)
CODES = {"flat": flat_code, "one-hot": one_hot_code, "binary": binary_code}


def scene(channels: int, size: tuple[int, int], seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    silhouette = torch.rand(height, width, generator=generator) * 0.8 + 0.2
    features = 4.0 * torch.randn(channels, height, width, generator=generator) * silhouette
    labels = torch.randint(0, 10, (height, width), generator=generator, dtype=torch.int32)
    return features, silhouette, labels


@pytest.mark.parametrize("instruction_set", available_instruction_sets())
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (4, 4), (17, 31), (40, 48)])
@pytest.mark.parametrize("name", CODES)
def test_kernel_equals_autograd(monkeypatch, name, size, instruction_set):
    monkeypatch.setattr(semantic, "kernels_for", lambda tensor: load_variant(instruction_set))
    code = CODES[name](TREE)
    images = scene(code.channels, size)
    weights = SemanticLossWeights(moves_geometry=True)
    actual = SemanticLoss(code, weights)(*images, (0, 10))
    expected = semantic_loss_torch(code, images, weights)
    assert actual.value == pytest.approx(expected.value, rel=1e-5, abs=1e-9)
    assert torch.allclose(actual.features, expected.features, atol=1e-6)
    assert torch.allclose(actual.silhouette, expected.silhouette, atol=1e-5)


@pytest.mark.parametrize("name", CODES)
def test_large_logits_stay_finite(name):
    code = CODES[name](TREE)
    features, silhouette, labels = scene(code.channels, (8, 16))
    result = SemanticLoss(code, SemanticLossWeights())(features * 1e4, silhouette, labels, (0, 1))
    assert np.isfinite(result.value) and torch.isfinite(result.features).all()


def test_void_and_translucent_pixels_are_ignored():
    code = one_hot_code(TREE)
    features, silhouette, labels = scene(code.channels, (20, 20))
    result = SemanticLoss(code, SemanticLossWeights())(features, silhouette, labels, (0, 1))
    counted = (labels > 0) & (silhouette >= 0.5)
    assert (result.features[:, ~counted] == 0).all()
    assert (result.features[:, counted].abs().sum(0) > 0).all()
    assert result.silhouette is None


def test_loss_of_an_image_without_labels_is_zero():
    code = one_hot_code(TREE)
    features, silhouette, labels = scene(code.channels, (6, 7))
    network = NetworkDecoder(code.channels, len(TREE), generator=torch.Generator())
    loss = SemanticLoss(code, SemanticLossWeights(inter_from=0), network)
    result = loss(features, silhouette, torch.zeros_like(labels), (5, 10))
    assert result.value == 0.0 and not result.features.any()


def trained(code, weights, steps):
    network = NetworkDecoder(code.channels, len(TREE), generator=torch.Generator().manual_seed(0))
    loss = SemanticLoss(code, weights, network)
    before = {name: a.copy() for name, a in network.state().items()}
    for step in steps:
        result = loss(*scene(code.channels, (20, 20)), (step, 60))
    after = network.state()
    return any((before[n] != after[n]).any() for n in before), result


def test_inter_level_term_starts_at_its_iteration():
    code = one_hot_code(TREE)
    weights = SemanticLossWeights(inter_from=15)
    assert not trained(code, weights, [0, 14])[0]
    assert trained(code, weights, [15])[0]


def test_inter_level_term_starts_at_a_quarter_of_short_calls():
    code = one_hot_code(TREE)
    network = NetworkDecoder(code.channels, len(TREE), generator=torch.Generator())
    loss = SemanticLoss(code, SemanticLossWeights(inter_from=15), network)
    images = scene(code.channels, (20, 20))
    alone = SemanticLoss(code, SemanticLossWeights())(*images, (0, 12)).value
    assert loss(*images, (2, 12)).value == alone
    assert loss(*images, (3, 12)).value > alone


def test_sampled_inter_level_term_is_unbiased():
    """The gradient averaged over many samples is that of all pixels."""
    code = one_hot_code(TREE)
    images = scene(code.channels, (24, 24))

    def gradient(pixels: int, rounds: int) -> torch.Tensor:
        total = torch.zeros_like(images[0])
        for seed in range(rounds):
            network = NetworkDecoder(
                code.channels, len(TREE), generator=torch.Generator().manual_seed(2)
            )
            weights = SemanticLossWeights(inter_from=0, inter_pixels=pixels)
            total += SemanticLoss(code, weights, network, seed)(*images, (1, 4)).features
        intra = SemanticLoss(code, SemanticLossWeights())(*images, (1, 4)).features
        return total / rounds - intra

    every, sampled = gradient(0, 1), gradient(40, 400)
    scale = every.abs().max()
    assert (sampled.sum((1, 2)) - every.sum((1, 2))).abs().max() < 0.1 * every.abs().sum() / 7
    assert (sampled - every).abs().mean() < 0.15 * scale


def test_network_learns_to_decode():
    code = binary_code(TREE)
    network = NetworkDecoder(code.channels, len(TREE), generator=torch.Generator().manual_seed(0))
    labels = torch.arange(1, 10).repeat(20)
    values = code.start_values[labels].T.contiguous()
    first = network.learn(values, labels)[0]
    for _ in range(150):
        last = network.learn(values, labels)[0]
    assert last < 0.05 * first
    assert (network.logits(values).argmax(0) + 1 == labels).all()


def test_gradient_of_the_network_agrees_with_finite_differences():
    code = one_hot_code(TREE)
    labels = torch.tensor([1, 5, 9])
    values = torch.randn(code.channels, 3, generator=torch.Generator().manual_seed(1))

    def fresh() -> NetworkDecoder:
        return NetworkDecoder(code.channels, len(TREE), generator=torch.Generator().manual_seed(0))

    gradient = fresh().learn(values, labels)[1]
    step = 1e-2
    moved = values.clone()
    moved[2, 1] += step
    low = values.clone()
    low[2, 1] -= step
    numeric = (fresh().learn(moved, labels)[0] - fresh().learn(low, labels)[0]) / (2 * step) * 3
    assert float(gradient[2, 1]) == pytest.approx(numeric, rel=2e-2, abs=1e-3)


def test_restored_network_continues_identically():
    code = one_hot_code(TREE)
    labels = torch.tensor([1, 5, 9, 2])
    values = torch.randn(code.channels, 4, generator=torch.Generator().manual_seed(1))
    first = NetworkDecoder(code.channels, len(TREE), generator=torch.Generator().manual_seed(0))
    for _ in range(3):
        first.learn(values, labels)
    second = NetworkDecoder(code.channels, len(TREE), generator=torch.Generator().manual_seed(7))
    second.restore(first.state())
    assert first.learn(values, labels)[0] == second.learn(values, labels)[0]
    assert torch.equal(first.logits(values), second.logits(values))


def colour_scene() -> tuple[ColourCode, tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    palette = np.random.default_rng(3).random((len(TREE), 3)).astype(np.float32)
    code = ColourCode(TREE, palette)
    _, silhouette, labels = scene(3, (18, 24))
    noise = torch.rand(3, 18, 24, generator=torch.Generator().manual_seed(5))
    return code, ((0.5 * noise + 0.25) * silhouette, silhouette, labels)


def test_loss_of_the_semantic_colour_includes_ssim():
    """G-4 for the semantic colour: 0.8 * L1 + 0.2 * (1 - SSIM)."""
    code, (features, _, _) = colour_scene()
    silhouette, labels = torch.ones(18, 24), torch.full((18, 24), 2, dtype=torch.int32)
    labels[:, 12:] = 5
    weights = SemanticLossWeights(weight=1.0, structure=0.2)
    loss = SemanticLoss(code, weights)(features, silhouette, labels, (0, 1))
    wanted = code.codewords[labels.long()].permute(2, 0, 1)
    l1, ssim = float((features - wanted).abs().mean()), float(ssim_torch(features, wanted))
    assert loss.value == pytest.approx(0.8 * l1 + 0.2 * (1.0 - ssim), rel=1e-5)
    perfect = SemanticLoss(code, weights)(wanted.contiguous(), silhouette, labels, (0, 1))
    assert perfect.value == pytest.approx(0.0, abs=1e-6)


def test_gradient_of_ssim_agrees_with_finite_differences():
    """At valid pixels; it is zero at all others."""
    code, images = colour_scene()
    features, silhouette, labels = (image.double() for image in images)
    labels = labels.to(torch.int32)
    weights = SemanticLossWeights(structure=0.7, moves_geometry=True)

    def value(features: torch.Tensor, silhouette: torch.Tensor) -> float:
        return semantic_loss_torch(code, (features, silhouette, labels), weights).value

    found = semantic_loss_torch(code, (features, silhouette, labels), weights)
    counted = (labels > 0) & (silhouette >= weights.min_silhouette)
    assert not found.features[:, ~counted].any() and not found.silhouette[~counted].any()
    step = 1e-6
    for row, column in counted.nonzero()[::60].tolist():
        moved = features.clone()
        moved[1, row, column] += step
        slope = (value(moved, silhouette) - value(features, silhouette)) / step * labels.numel()
        assert float(found.features[1, row, column]) == pytest.approx(slope, rel=1e-3, abs=1e-5)
        thicker = silhouette.clone()
        thicker[row, column] += step
        slope = (value(features, thicker) - value(features, silhouette)) / step * labels.numel()
        assert float(found.silhouette[row, column]) == pytest.approx(slope, rel=1e-3, abs=1e-5)


def test_ssim_does_not_affect_other_codes():
    code = one_hot_code(TREE)
    images = scene(code.channels, (12, 12))
    plain = SemanticLoss(code, SemanticLossWeights())(*images, (0, 1))
    mixed = SemanticLoss(code, SemanticLossWeights(structure=0.2))(*images, (0, 1))
    assert mixed.value == plain.value and torch.equal(mixed.features, plain.features)


def test_without_normalisation_the_inter_level_loss_is_the_plain_cross_entropy():
    """H-13; normalised, it is divided by the loss of a uniform prediction."""
    images = scene(flat_code(TREE).channels, (8, 8))
    terms = []
    for normalise in (True, False):
        options = SemanticsOptions(
            code=CodeOptions(kind="flat", normalise=normalise),
            loss=SemanticLossWeights(inter_from=0),
            network=NetworkOptions(use=True),
        )
        mapping = build_semantic_mapping(options, build_code(options.code, TREE), 0)
        intra = SemanticLoss(mapping._loss.code, options.loss)(*images, (0, 1)).value
        terms.append(mapping._loss(*images, (0, 1)).value - intra)
    assert terms[1] == pytest.approx(np.log(len(TREE)) * terms[0], rel=1e-5)
