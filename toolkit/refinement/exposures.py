"""One exposure for all submaps.

A camera adapts, and each submap has the exposure of its anchor. Where two of them show the same
place their colours differ by a gain and a bias; all of these together say what each submap has
to be multiplied by, with the first one left as it is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Fewer common voxels say nothing about a pair.
_FEWEST = 100
# Differences of colour far beyond it are of other things, not of exposure.
_SCALE = 0.05
_ROUNDS = 30
# Without overlaps a submap keeps its exposure: so many voxels hold it where it is.
_PRIOR = 1.0

# Keys [V], ascending, and mean colours [V, 3] of a submap's voxels; nan where there is no surface.
Voxels = tuple[NDArray[np.int64], NDArray[np.float64]]


def agreed_exposures(submaps: dict[int, Voxels]) -> dict[int, tuple[float, float]]:
    """Gain and bias of each submap, by number; the first submap's are 1 and 0.

    Robust least squares over all pairs that share enough voxels:
    gain_a * colour_a + bias_a = gain_b * colour_b + bias_b.
    """
    numbers = sorted(submaps)
    place = {number: k for k, number in enumerate(numbers)}
    pairs = [
        (place[a], place[b], *common)
        for i, a in enumerate(numbers)
        for b in numbers[i + 1 :]
        if len((common := _common(submaps[a], submaps[b]))[0]) >= 3 * _FEWEST
    ]
    values = np.tile([1.0, 0.0], len(numbers))
    for _ in range(_ROUNDS if pairs else 0):
        values = _solved(pairs, values)
    return {n: (float(values[2 * k]), float(values[2 * k + 1])) for n, k in place.items()}


def _common(a: Voxels, b: Voxels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Colours [3 M] of the voxels that both have, channels one after another."""
    _, in_a, in_b = np.intersect1d(a[0], b[0], assume_unique=True, return_indices=True)
    first, second = a[1][in_a].T.ravel(), b[1][in_b].T.ravel()
    known = np.isfinite(first) & np.isfinite(second)
    return first[known], second[known]


def _solved(pairs: list[tuple], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """One round of re-weighted least squares."""
    size = len(values)
    H, g = np.zeros((size, size)), np.zeros(size)
    # The prior, and the first submap, which stays.
    start = np.tile([1.0, 0.0], size // 2)
    prior = np.full(size, _PRIOR)
    prior[:2] = 1e12
    H[np.diag_indices(size)] += prior
    g += prior * start
    for a, b, first, second in pairs:
        at = [2 * a, 2 * a + 1, 2 * b, 2 * b + 1]
        J = np.stack([first, np.ones_like(first), -second, -np.ones_like(second)], axis=1)
        residual = J @ values[at]
        weight = 1.0 / (1.0 + (residual / _SCALE) ** 2)
        H[np.ix_(at, at)] += J.T @ (J * weight[:, None])
    solved = np.asarray(np.linalg.solve(H, g), dtype=np.float64)
    solved[:2] = start[:2]
    return solved
