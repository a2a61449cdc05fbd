"""Semantic landmark vectors: class frequencies of a view, weighted by rarity (G-7).

The vector of a view has one entry per class c: the fraction of the class in the view times its
inverse frequency. The paper prints M / M_c * log(N / (1 + N_c)), where M_c of the M observed
Gaussians and N_c of the N Gaussians in the map have class c. This divides by zero for classes
out of view, lets a single stray Gaussian dominate, and counts rarity twice. We use tf-idf as in
text retrieval:

    w(c) = sqrt(M_c / M) * log((1 + K) / (1 + K_c)),   K_c of the K keyframes observe class c,

scaled to unit length. The square root reduces the weight of large surfaces such as walls.
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
    """Compute the landmark vectors [K, C] of K keyframes: unit length, or zero if uninformative.

    The weights depend on all K keyframes, so vectors of different calls are not comparable.

    Args:
        counts: [K, C] observed pixels or Gaussians per class, void excluded.
        options: weighting; default if None.
        map_counts: [C] Gaussians per class in the map, for the paper's weighting only.

    Raises:
        ValueError: shapes are wrong, a count is negative, or map_counts is missing.
    """
    options = options or LandmarkOptions()
    counts = np.asarray(counts)
    if counts.ndim != 2 or (counts.size and counts.min() < 0):
        raise ValueError(f"counts must be non-negative with shape [K, C], got {list(counts.shape)}")
    if options.weighting == "paper":
        vectors = _paper_vectors(counts, options.min_count, map_counts)
    else:
        counts = np.where(counts >= max(1, options.min_count), counts, 0)
        frequencies = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        if options.weighting == "sqrt":
            frequencies = np.sqrt(frequencies)
        vectors = frequencies * keyframe_idf(counts)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def keyframe_idf(counts: Counts) -> Array:
    """log((1 + K) / (1 + K_c)) [C] from counts [K, C]: 0 for classes that all keyframes see."""
    observing = np.count_nonzero(counts, axis=0)
    return np.log((1.0 + len(counts)) / (1.0 + observing))


def gaussian_idf(map_counts: Counts) -> Array:
    """log(N / (1 + N_c)) [C] as in G, for N_c Gaussians of class c and N in total."""
    map_counts = np.asarray(map_counts)
    return np.log(max(1.0, map_counts.sum()) / (1.0 + map_counts))


def landmark_distance(first: Array, second: Array) -> float | None:
    """Euclidean distance of two vectors [C] from one `landmark_vectors` call, in [0, sqrt 2].

    None if either vector is zero, that is, if a view shows only classes that all keyframes see.
    """
    if not first.any() or not second.any():
        return None
    return float(np.linalg.norm(first - second))


def _paper_vectors(counts: Counts, floor: int, map_counts: Counts | None) -> Array:
    """M / max(M_c, floor) * f(c) for visible classes c (G-7), not normalised."""
    if map_counts is None or np.shape(map_counts) != counts.shape[1:]:
        raise ValueError(f"the paper's weighting needs map_counts [{counts.shape[1]}]")
    observed = counts.sum(axis=1, keepdims=True)
    scores = observed / np.maximum(counts, max(1, floor)) * gaussian_idf(map_counts)
    return np.where(counts > 0, scores, 0.0)
