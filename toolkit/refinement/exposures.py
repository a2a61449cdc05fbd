"""One exposure for all submaps.

A camera adapts, and each submap has the exposure of its anchor. Where two of them show the same
place their colours differ by a factor; all of these together say what each submap has to be
multiplied by, with the first one left as it is.

A factor alone, and told by logarithms, in which both submaps count alike. A gain and a bias, one
submap fitted to the next, came out the flatter the noisier the colours are: after twenty submaps
a fourth of the contrast was left.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Fewer common voxels say nothing about a pair.
_FEWEST = 100
# Differences of colour far beyond it are of other things, not of exposure.
_SCALE = 0.05
# Colours below it tell no factor.
_DARKEST = 0.02
_ROUNDS = 30
# Without overlaps a submap keeps its exposure: so many white voxels hold it where it is.
_PRIOR = 1.0

Array = NDArray[np.float64]
# Keys [V], ascending, and mean colours [V, 3] of a submap's voxels; nan where there is no surface.
Voxels = tuple[NDArray[np.int64], Array]


def agreed_gains(submaps: dict[int, Voxels]) -> dict[int, float]:
    """What each submap's colours are multiplied by, by number; 1 for the first one.

    Robust least squares over all pairs that share enough voxels, in units of colour:
    grey (log gain_a + log colour_a - log gain_b - log colour_b), with the pair's mean as grey.
    """
    numbers = sorted(submaps)
    pairs = [
        (i, k, *common)
        for k, b in enumerate(numbers)
        for i, a in enumerate(numbers[:k])
        if len((common := _common(submaps[a], submaps[b]))[0]) >= 3 * _FEWEST
    ]
    logs = np.zeros(len(numbers))
    for _ in range(_ROUNDS if pairs else 0):
        logs = _solved(pairs, logs)
    return {number: float(np.exp(log)) for number, log in zip(numbers, logs, strict=True)}


def _common(a: Voxels, b: Voxels) -> tuple[Array, Array]:
    """Logarithm of b / a, and grey, [3 M] of what both have, channels one after another."""
    _, in_a, in_b = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    first, second = a[1][in_a].T.ravel(), b[1][in_b].T.ravel()
    with np.errstate(invalid="ignore"):
        known = (first > _DARKEST) & (second > _DARKEST)
    first, second = first[known], second[known]
    return np.log(second / first), 0.5 * (first + second)


def _solved(pairs: list[tuple[int, int, Array, Array]], logs: Array) -> Array:
    """One round of re-weighted least squares."""
    H, g = np.diag(np.full(len(logs), _PRIOR)), np.zeros(len(logs))
    for a, b, ratio, grey in pairs:
        residual = grey * (logs[a] - logs[b] - ratio)
        weight = grey**2 / (1.0 + (residual / _SCALE) ** 2)
        H[np.ix_([a, b], [a, b])] += weight.sum() * np.array([[1.0, -1.0], [-1.0, 1.0]])
        g[[a, b]] += (weight @ ratio) * np.array([1.0, -1.0])
    # The first submap stays.
    solved = np.zeros(len(logs))
    solved[1:] = np.linalg.solve(H[1:, 1:], g[1:])
    return solved
