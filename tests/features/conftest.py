"""Fixtures: all encoders, and images to encode."""

from __future__ import annotations

import pytest
import torch
from places import place

from toolkit.semantics.features.builtin import BuiltinEncoder, ColourHistogramEncoder


@pytest.fixture(params=["builtin", "colour-histogram", "dinov2"])
def encoder(request):
    if request.param == "builtin":
        return BuiltinEncoder()
    if request.param == "colour-histogram":
        return ColourHistogramEncoder()
    from toolkit.semantics.features.dinov2 import Dinov2Encoder

    return Dinov2Encoder(request.getfixturevalue("tiny_dinov2"), longest_side=40, device="cpu")


@pytest.fixture
def views() -> torch.Tensor:
    """[6, 3, 60, 80]: one view of each of six places."""
    return torch.stack([place(seed)[:, :, 10:90] for seed in range(6)])
