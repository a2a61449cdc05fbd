"""Motions that colour and depth choose alone, compared by their covariances."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.splatting.alignment import covariance

BLOCKS = covariance._ROWS * covariance._COLUMNS


def term(information: float, mean: float, spread: float) -> covariance._Term:
    """A term whose blocks pull along the first axis by a mean, with a spread around it."""
    gradients = np.zeros((BLOCKS, 6))
    gradients[:, 0] = mean + spread * np.resize([1.0, -1.0], BLOCKS)
    return covariance._Term(information * np.eye(6), gradients)


@pytest.mark.parametrize("spread", [0.0, 1.0, 30.0])
def test_it_is_the_difference_in_standard_deviations(spread):
    colour, depth = term(100.0, 0.5, spread), term(400.0, -0.25, spread)
    found = covariance._disagreement(colour, depth, BLOCKS)
    # The prior of each term is a small share of the sum of both.
    H = [h + covariance._MIN_SHARE * 500.0 for h in (100.0, 400.0)]
    difference = BLOCKS * (0.5 / H[0] + 0.25 / H[1])
    inflation = BLOCKS / (BLOCKS - 6)
    squares = [BLOCKS * (mean**2 + spread**2) * inflation for mean in (0.5, 0.25)]
    variance = sum((square + h) / h**2 for square, h in zip(squares, H, strict=True))
    assert found == pytest.approx(difference**2 / variance / 6.0, rel=1e-6)
