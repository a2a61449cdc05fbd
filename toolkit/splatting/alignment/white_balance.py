"""White balance of images relative to each other, from colours of the same surfaces.

The balance of an image is the vector v of log gains of its channels, whose sum is 0. Two images of
a surface differ in v by the logarithms of the ratios of their colours, without the mean over the
channels of each pixel: exposure, vignetting, shading and highlights change the channels alike.

A single pair of images determines the difference symmetrically, by a median. A least-squares fit
of one image to another, or to a map, underestimates gains where colours are noisy, and
differences along a sequence would add up. Balances follow from all pairs of overlapping images
together, with a weak prior for neutral ones, which bounds the drift where the camera never returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Balance
from toolkit.base.geometry.linear_systems import solve_reproducibly
from toolkit.splatting.alignment.reference import LUMA

Array = NDArray[np.float64]

# Darker channels, in colours in [0, 1], contain offsets and noise rather than the hue of the light.
MIN_COLOUR = 0.08
# Weight of the prior of a keyframe, relative to a pair; it takes effect over a hundred keyframes.
PRIOR = 1e-4
# Scale of the robust weights of pairs of keyframes, in logarithms.
SCALE = 0.01
# Standard error at which a pair has half the largest weight, in logarithms.
_HALF_WEIGHT_ERROR = 0.003
# Minimum number of pixels of a pair.
_MIN_PIXELS = 250
# Maximum number of rounds, and the change of log gains that ends them.
_ROUNDS, _CONVERGED = 10, 1e-6


@dataclass(frozen=True)
class BalanceDifference:
    """Difference of two balances, balance of the second minus that of the first.

    Attributes:
        log_gains: [3], with the sum 0.
        weight: in (0, 1], larger for smaller standard errors.
    """

    log_gains: Array
    weight: float


@dataclass(frozen=True)
class BalanceLink:
    """Difference of the balances of two images, by their numbers."""

    first: int
    second: int
    difference: BalanceDifference


def balance_difference(first: NDArray, second: NDArray) -> BalanceDifference | None:
    """Compare the colours of the same surface in two images.

    Args:
        first, second: [P, 3] colours, each image at its own white balance. Only pixels are used
            whose channels are all bright enough in both.

    Returns:
        The difference; None if too few pixels determine it.
    """
    # By rows of pixels: reductions over an axis of three are slow.
    one, other = np.ascontiguousarray(first.T), np.ascontiguousarray(second.T)
    red, green, blue = np.minimum(one, other) >= MIN_COLOUR
    bright = red & green & blue
    count = int(bright.sum())
    if count < _MIN_PIXELS:
        return None
    ratios = np.log(one[:, bright].astype(np.float64) / other[:, bright])
    hues = ratios - ratios.sum(axis=0) / 3.0
    median = _medians(hues)
    # For a normal distribution, from the median absolute deviation.
    deviation = 1.48 * float(_medians(np.abs(hues - median[:, None])).max())
    error = 1.25 * deviation / count**0.5
    return BalanceDifference(
        median - median.mean(), 1.0 / (1.0 + (error / _HALF_WEIGHT_ERROR) ** 2)
    )


def _medians(values: Array) -> Array:
    """Medians of rows; `np.median` takes three times as long for rows of a few thousand values."""
    count = values.shape[1]
    low, high = (count - 1) // 2, count // 2
    parts = np.partition(values, (low, high), axis=1)
    return np.asarray(0.5 * (parts[:, low] + parts[:, high]))


def solve_balances(
    known: Array,
    count: int,
    links: Sequence[BalanceLink],
    prior: float = PRIOR,
    scale: float = SCALE,
) -> Array:
    """Balances that fit the differences of all linked images.

    Args:
        known: [K, 3] log gains of the first K images.
        count: number of images N.
        prior: weight of neutral balances.
        scale: residual of a pair, in logarithms, that halves its robust weight; pairs must not
            become outliers because of the prior.

    Returns:
        Log gains [N, 3]; those of images without links are 0, or as known.
    """
    fixed = len(known)
    values = np.concatenate([known, np.zeros((count - fixed, 3))])
    if count == fixed or not links:
        return values
    first = np.array([link.first for link in links])
    second = np.array([link.second for link in links])
    differences = np.array([link.difference.log_gains for link in links])
    weights = np.array([link.difference.weight for link in links])
    robust = np.ones(len(links))
    for _ in range(_ROUNDS):
        H, g = _normal_equations(values, first, second, differences, weights * robust)
        H, g = H + prior * np.eye(count), g - prior * values
        change = solve_reproducibly(H[fixed:, fixed:], g[fixed:])
        values[fixed:] += change
        if np.abs(change).max() < _CONVERGED:
            break
        residuals = values[second] - values[first] - differences
        robust = 1.0 / (1.0 + (residuals**2).sum(axis=1) / scale**2)
    return values


def _normal_equations(
    values: Array, first: NDArray, second: NDArray, differences: Array, weights: Array
) -> tuple[Array, Array]:
    """Normal equations [N, N] and [N, 3] of the links."""
    H, g = np.zeros((len(values), len(values))), np.zeros_like(values)
    missing = weights[:, None] * (differences - values[second] + values[first])
    for ends, sign in ((second, 1.0), (first, -1.0)):
        np.add.at(H, (ends, ends), weights)
        np.add.at(g, ends, sign * missing)
    np.add.at(H, (first, second), -weights)
    np.add.at(H, (second, first), -weights)
    return H, g


def balance_gains(log_gains: Array, mean_colour: Array) -> Balance:
    """Gains of the channels that do not change the mean intensity of an image.

    Args:
        log_gains: [3].
        mean_colour: [3] of the image before the gains are applied.
    """
    gains = np.exp(log_gains)
    after = float(LUMA @ (gains * mean_colour))
    red, green, blue = gains * (float(LUMA @ mean_colour) / after if after > 0.0 else 1.0)
    return (float(red), float(green), float(blue))


def is_neutral(log_gains: Array, min_change: float) -> bool:
    """Whether no channel changes by a fraction of at least `min_change`."""
    return bool(np.abs(np.expm1(log_gains)).max(initial=0.0) < min_change)
