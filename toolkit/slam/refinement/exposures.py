"""Exposure compensation between submaps.

With automatic exposure, each submap has the exposure of its anchor. Where two submaps overlap,
their colours differ by a gain and a bias, and by their white balance. The exposure of every submap
relative to the first one is estimated from all overlapping pairs.

The estimate of a pair is symmetric (`exposure_between`). Ordinary least squares from one submap to
the next underestimates the gain when colours are noisy: after twenty submaps a quarter of the
contrast was left.

The map itself is at the typical exposure of its keyframes. Other programs show colours above 1 as
1, and the first image may be exposed longer than the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, NEUTRAL, Balance, Exposure
from toolkit.base.geometry.linear_systems import solve_reproducibly
from toolkit.splatting.alignment.exposure import IntensityStatistics, exposure_between
from toolkit.splatting.alignment.white_balance import (
    BalanceLink,
    balance_difference,
    balance_gains,
    is_neutral,
    solve_balances,
)

# Minimum number of common voxels of a pair.
_MIN_COMMON = 100
# Scale of the robust weight; larger colour differences are not caused by exposure.
_SCALE = 0.05
_ROUNDS = 10
# Smaller changes of a channel's gain are ignored: colours of Gaussians are less accurate than those
# of images.
_MIN_CHANGE = 0.02
# Weight of neutral balances, relative to a pair: submaps of a run share the reference of their
# first keyframes already.
_BALANCE_PRIOR = 0.005
# Scale of the robust weight of a pair's white balance, in logarithms.
_BALANCE_SCALE = 0.05
# Smaller differences in gain, bias and white balance of the typical exposure are ignored.
_TYPICAL = 0.02
# Weight of the prior that keeps the exposure of a submap without overlaps.
_PRIOR = 1.0

Array = NDArray[np.float64]
# Keys [V], ascending, and mean colours [V, 3] of a submap's voxels; nan where there is no surface.
Voxels = tuple[NDArray[np.int64], Array]


@dataclass(frozen=True)
class _Link:
    """Relative exposure of two submaps: colours of first = gain * colours of second + bias."""

    first: int
    second: int
    gain: float
    bias: float
    weight: float


def estimate_exposures(submaps: dict[int, Voxels]) -> dict[int, Exposure]:
    """Estimate the exposure of each submap relative to the map; the first is the identity.

    Solves least squares over all pairs with enough common voxels, for log gains and then biases.
    """
    numbers = sorted(submaps)
    links = []
    pairs = []
    for k, b in enumerate(numbers):
        for i, a in enumerate(numbers[:k]):
            first, second = _common(submaps[a], submaps[b])
            if len(first) >= _MIN_COMMON:
                links.append(_link(i, k, first.T.ravel(), second.T.ravel()))
                pairs.append((first, second))
    gains = np.exp(_potentials(len(numbers), links, [np.log(link.gain) for link in links]))
    biases = _potentials(len(numbers), links, [gains[x.first] * x.bias for x in links])
    exposures = [Exposure(float(g), float(b)) for g, b in zip(gains, biases, strict=True)]
    balances = _balances([submaps[n][1] for n in numbers], exposures, links, pairs)
    return {
        n: exposure.with_balance(balance)
        for n, exposure, balance in zip(numbers, exposures, balances, strict=True)
    }


def at_typical_exposure(
    submaps: Mapping[int, Exposure], keyframes: Mapping[int, Sequence[Exposure]]
) -> dict[int, Exposure]:
    """Exposures of submaps relative to a map at the typical exposure of all keyframes.

    Args:
        submaps: exposure of each submap relative to one of them.
        keyframes: exposures of the keyframes of each submap, relative to their submap.
    """
    of_keyframes = [
        submap.after(exposure) for n, submap in submaps.items() for exposure in keyframes[n]
    ]
    change = typical_exposure(of_keyframes).inverse()
    return {n: change.after(exposure) for n, exposure in submaps.items()}


def typical_exposure(exposures: Sequence[Exposure]) -> Exposure:
    """The medians of gain, bias and white balance; the identity where they are close to it."""
    values = np.array([(e.gain, e.bias, *e.balance) for e in exposures]).reshape(-1, 5)
    if not len(values):
        return IDENTITY
    gain, bias, *balance = np.median(values, axis=0)
    if np.abs([gain - 1.0, bias, *(np.array(balance) - 1.0)]).max() < _TYPICAL:
        return IDENTITY
    red, green, blue = map(float, balance)
    return Exposure(float(gain), float(bias), balance=(red, green, blue))


def _common(a: Voxels, b: Voxels) -> tuple[Array, Array]:
    """Colours [M, 3] of the voxels common to both submaps."""
    _, in_a, in_b = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    first, second = a[1][in_a], b[1][in_b]
    known = (np.isfinite(first) & np.isfinite(second)).all(axis=1)
    return first[known], second[known]


def _balances(
    colours: list[Array],
    exposures: list[Exposure],
    links: list[_Link],
    pairs: list[tuple[Array, Array]],
) -> list[Balance]:
    """White balance of each submap after its gain and bias; neutral where it changes little.

    Args:
        colours: [V, 3] of all voxels, by submap.
        pairs: colours [M, 3] of the common voxels of each link.
    """
    differences = []
    for link, (first, second) in zip(links, pairs, strict=True):
        adjusted = exposures[link.first].apply(first), exposures[link.second].apply(second)
        difference = balance_difference(*adjusted)
        if difference is not None:
            differences.append(BalanceLink(link.first, link.second, difference))
    balances = []
    first_one = np.zeros((1, 3))
    values = solve_balances(
        first_one, len(colours), differences, prior=_BALANCE_PRIOR, scale=_BALANCE_SCALE
    )
    for own, exposure, value in zip(colours, exposures, values, strict=True):
        solid = own[np.isfinite(own).all(axis=1)]
        neutral = is_neutral(value, _MIN_CHANGE) or not len(solid)
        mean = exposure.apply(solid).mean(axis=0) if len(solid) else np.ones(3)
        balances.append(NEUTRAL if neutral else balance_gains(value, mean))
    return balances


def _link(a: int, b: int, first: Array, second: Array) -> _Link:
    """Estimate the relative exposure of two submaps by iteratively reweighted least squares."""
    exposure = Exposure(float(np.median(first) / max(np.median(second), 1e-3)))
    for _ in range(_ROUNDS):
        residual = first - (exposure.gain * second + exposure.bias)
        weight = 1.0 / (1.0 + (residual / _SCALE) ** 2)
        exposure = exposure_between(_statistics(second, weight), _statistics(first, weight))
    return _Link(a, b, exposure.gain, exposure.bias, float(weight.sum()))


def _statistics(colours: Array, weight: Array) -> IntensityStatistics:
    mean = float(np.average(colours, weights=weight))
    variance = float(np.average((colours - mean) ** 2, weights=weight))
    return IntensityStatistics(mean, variance**0.5)


def _potentials(count: int, links: list[_Link], differences: list[float]) -> Array:
    """Values [count] whose differences (second - first) fit the links; the first is 0."""
    H, g = np.diag(np.full(count, _PRIOR)), np.zeros(count)
    for link, difference in zip(links, differences, strict=True):
        ends = [link.first, link.second]
        H[np.ix_(ends, ends)] += link.weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
        g[ends] += link.weight * difference * np.array([-1.0, 1.0])
    values = np.zeros(count)
    values[1:] = solve_reproducibly(H[1:, 1:], g[1:])
    return values
