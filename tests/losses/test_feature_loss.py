"""Feature loss of the papers."""

from __future__ import annotations

import pytest
import torch

from toolkit.features.builtin import BuiltinEncoder
from toolkit.losses.features import FeatureLoss


def picture(seed: int) -> torch.Tensor:
    """Smooth random images, in which neighbouring pixels are similar."""
    small = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(small, (60, 80), mode="bilinear")[0]


def test_loss_is_zero_for_identical_images():
    loss, by_picture = FeatureLoss(BuiltinEncoder(), 0.5).gradient(picture(0), picture(0))
    assert loss == 0.0
    assert torch.count_nonzero(by_picture) == 0


def test_loss_is_proportional_to_the_weight():
    one, by_one = FeatureLoss(BuiltinEncoder(), 1.0).gradient(picture(0), picture(1))
    half, by_half = FeatureLoss(BuiltinEncoder(), 0.5).gradient(picture(0), picture(1))
    assert one > 0.01
    assert half == pytest.approx(0.5 * one)
    assert torch.allclose(by_half, 0.5 * by_one)


def test_derivative_agrees_with_finite_differences():
    term, drawn, observed = FeatureLoss(BuiltinEncoder(), 1.0), picture(0), picture(1)
    _, by_picture = term.gradient(drawn, observed)
    step = 1e-3 * by_picture / by_picture.norm()
    ahead, _ = term.gradient(drawn + step, observed)
    behind, _ = term.gradient(drawn - step, observed)
    slope = float(by_picture.norm()) / drawn[0].numel()  # undo the factor
    assert (ahead - behind) / 2e-3 == pytest.approx(slope, rel=0.05)
