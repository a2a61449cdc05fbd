"""Encoders of every kind, and pictures to describe."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from places import place

from toolkit.features.builtin import BuiltinEncoder
from toolkit.features.colour_histogram import ColourHistogramEncoder


@pytest.fixture(scope="session")
def tiny_dinov2(tmp_path_factory) -> Path:
    """A DINOv2 with random weights, patches of 8 pixels, 16 channels."""
    transformers = pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("models") / "dinov2"
    torch.manual_seed(0)
    config = transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        patch_size=8,
        image_size=32,
        mlp_ratio=2,
    )
    transformers.Dinov2Model(config).save_pretrained(folder)
    return folder


@pytest.fixture(params=["builtin", "colour-histogram", "dinov2-class", "dinov2-mean"])
def encoder(request):
    if request.param == "builtin":
        return BuiltinEncoder()
    if request.param == "colour-histogram":
        return ColourHistogramEncoder()
    from toolkit.features.dinov2 import Dinov2Encoder

    folder = request.getfixturevalue("tiny_dinov2")
    return Dinov2Encoder(folder, request.param.split("-")[1], longest_side=40, device="cpu")


@pytest.fixture
def views() -> torch.Tensor:
    """[6, 3, 60, 80]: one view each of six places."""
    return torch.stack([place(seed)[:, :, 10:90] for seed in range(6)])
