"""Codebooks of numbers and of vectors, for files that store indices.

Everything is reproducible: initial centres follow from the order of the data, sums are in a fixed
order, and no random numbers are used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BINS = 4096
_ITERATIONS_1D = 10
# Share of a codebook that is spread evenly, so that rare values are not far from any number.
_EVEN = 0.3
_ITERATIONS = 8
# Clusters of the first level of the palette.
_GROUPS = 256
_ROUNDS = 10
# Rows whose distances to all centres are computed at once.
_ROWS = 8192


def codebook(values: NDArray[np.floating], size: int = 256) -> NDArray[np.float64]:
    """Return `size` sorted numbers that represent values with a small squared error.

    The density of the initial numbers is the cube root of that of the values, which is optimal for
    many numbers (Panter and Dite, 1951), and a constant. Lloyd's algorithm then refines them.
    """
    ordered = np.sort(values.reshape(-1).astype(np.float64))
    low, high = ordered[0], ordered[-1]
    if low == high:
        return np.full(size, low)
    edges = np.linspace(low, high, _BINS + 1)
    density = np.cbrt(np.histogram(ordered, edges)[0])
    density += _EVEN * density.mean()
    reached = np.concatenate([[0.0], np.cumsum(density)]) / density.sum()
    centres = np.interp((np.arange(size) + 0.5) / size, reached, edges)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_ITERATIONS_1D):
        ends = np.searchsorted(ordered, (centres[1:] + centres[:-1]) / 2.0)
        first, last = np.r_[0, ends], np.r_[ends, len(ordered)]
        filled = last > first
        means = (sums[last] - sums[first]) / np.maximum(last - first, 1)
        centres = np.sort(np.where(filled, means, centres))
    return centres


def nearest_codes(values: NDArray[np.floating], codes: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The index of the nearest of up to 256 sorted numbers, for each value."""
    return np.searchsorted((codes[1:] + codes[:-1]) / 2.0, values).astype(np.uint8)


def palette(
    vectors: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return at most `size` vectors [P, D] that represent others [N, D], and indices [N] of them.

    There are two levels: k-means divides the vectors into groups, and each group into a number of
    clusters that is proportional to its squared error. This takes seconds, and one level with
    65,536 clusters hours.
    """
    groups = min(_GROUPS, size)
    centres, owner = _k_means(vectors, groups)
    errors = np.bincount(owner, ((vectors - centres[owner]) ** 2).sum(axis=1), len(centres))
    counts = np.bincount(owner, minlength=len(centres))
    parts, index, used = [], np.zeros(len(vectors), np.int64), 0
    rows_by_group = np.split(np.argsort(owner, kind="stable"), np.cumsum(counts)[:-1])
    for rows, clusters in zip(rows_by_group, _shares(errors, counts, size), strict=True):
        if len(rows):
            part, nearest = _k_means(vectors[rows], int(clusters))
            index[rows] = used + nearest
            parts.append(part)
            used += len(part)
    return np.concatenate(parts), index


def _shares(
    errors: NDArray[np.number], counts: NDArray[np.integer], size: int
) -> NDArray[np.int64]:
    """The number of clusters of each group: at least one, at most one per vector."""
    shares, most = np.ones(len(errors), np.int64), np.maximum(counts, 1)
    for _ in range(_ROUNDS):
        # What a small group cannot use is left to the others.
        weights = np.where(shares < most, errors, 0.0)
        spare = max(size - int(shares.sum()), 0)
        more = np.floor(spare * weights / max(weights.sum(), 1e-30)).astype(np.int64)
        shares = np.minimum(shares + more, most)
    return shares


def _k_means(
    vectors: NDArray[np.float32], size: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Lloyd's algorithm, from evenly spaced vectors; clusters that become empty are moved."""
    if size >= len(vectors):
        return vectors.copy(), np.arange(len(vectors))
    centres = vectors[np.linspace(0, len(vectors) - 1, size).astype(np.int64)].copy()
    for _ in range(_ITERATIONS):
        nearest, errors = _nearest(vectors, centres)
        counts = np.bincount(nearest, minlength=size)
        for column, values in enumerate(vectors.T):
            sums = np.bincount(nearest, values, size)
            centres[:, column] = np.where(counts, sums / np.maximum(counts, 1), centres[:, column])
        empty = np.flatnonzero(counts == 0)
        centres[empty] = vectors[np.argsort(-errors, kind="stable")[: len(empty)]]
    return centres, _nearest(vectors, centres)[0]


def _nearest(
    vectors: NDArray[np.float32], centres: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """The index [N] of the nearest centre, and the squared distance to it."""
    nearest = np.zeros(len(vectors), np.int64)
    errors = np.zeros(len(vectors), np.float32)
    lengths = (centres**2).sum(axis=1)
    for start in range(0, len(vectors), _ROWS):
        part = vectors[start : start + _ROWS]
        distances = lengths - 2.0 * (part @ centres.T)
        found = distances.argmin(axis=1)
        nearest[start : start + _ROWS] = found
        errors[start : start + _ROWS] = distances[np.arange(len(part)), found]
        errors[start : start + _ROWS] += (part**2).sum(axis=1)
    return nearest, errors
