"""Semantic landmarks: which classes a view shows, the rare ones first (G-7).

A view's vector has an entry for each class c: how much of the view is of it, times how much
that tells. The paper prints M / M_c * log(N / (1 + N_c)) with M_c of the M observed and N_c of
the map's N Gaussians of class c. That divides by zero for classes out of view, lets a single
stray Gaussian outweigh all else, and counts rarity twice. As in text retrieval (tf-idf), here

    w(c) = sqrt(M_c / M) * log((1 + K) / (1 + K_c)),   K_c of the K keyframes see class c,

scaled to length 1. The square root keeps walls from drowning the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.loops.options import LandmarkOptions

Array = NDArray[np.float64]
Counts = NDArray[np.integer]


def landmark_vectors(
    counts: Counts, options: LandmarkOptions | None = None, map_counts: Counts | None = None
) -> Array:
    """Vectors [K, C] of K keyframes, each of length 1, or zero where no class tells anything.

    All are of one snapshot of the keyframes: never compare vectors of two calls.

    Args:
        counts: [K, C] observed pixels or Gaussians of each class, without void.
        options: how; default if None.
        map_counts: [C] Gaussians of each class in the map, for the paper's weighting only.

    Raises:
        ValueError: shapes are wrong, a count is negative, or map_counts is missing.
    """
    options = options or LandmarkOptions()
    counts = np.asarray(counts)
    if counts.ndim != 2 or (counts.size and counts.min() < 0):
        raise ValueError(f"counts must be [K, C], not negative, got {list(counts.shape)}")
    if options.weighting == "paper":
        vectors = _printed(counts, options.min_count, map_counts)
    else:
        counts = np.where(counts >= max(1, options.min_count), counts, 0)
        shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        if options.weighting == "sqrt":
            shares = np.sqrt(shares)
        vectors = shares * keyframe_idf(counts)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def keyframe_idf(counts: Counts) -> Array:
    """log((1 + K) / (1 + K_c)) [C] of K keyframes' counts [K, C]: 0 for what all see."""
    seen = np.count_nonzero(counts, axis=0)
    return np.log((1.0 + len(counts)) / (1.0 + seen))


def gaussian_idf(map_counts: Counts) -> Array:
    """G's log(N / (1 + N_c)) [C] of a map with N_c Gaussians of each class, N together."""
    map_counts = np.asarray(map_counts)
    return np.log(max(1.0, map_counts.sum()) / (1.0 + map_counts))


def landmark_distance(one: Array, other: Array) -> float | None:
    """Euclidean distance of two vectors [C] of one snapshot, in [0, sqrt 2].

    None where either is zero: a view of what every keyframe sees tells nothing.
    """
    if not one.any() or not other.any():
        return None
    return float(np.linalg.norm(one - other))


def _printed(counts: Counts, floor: int, map_counts: Counts | None) -> Array:
    """M / max(M_c, floor) * f(c) where class c is seen (G-7), without scaling."""
    if map_counts is None or np.shape(map_counts) != counts.shape[1:]:
        raise ValueError(f"the paper's weighting needs map_counts [{counts.shape[1]}]")
    observed = counts.sum(axis=1, keepdims=True)
    scores = observed / np.maximum(counts, max(1, floor)) * gaussian_idf(map_counts)
    return np.where(counts > 0, scores, 0.0)
