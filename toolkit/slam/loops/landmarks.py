"""Semantic landmark vectors: class frequencies of a view, weighted by rarity (G-7).

The vector of a view has one entry per class c. We use tf-idf as in text retrieval, scaled to unit
length:

    w(c) = sqrt(M_c / M) * log((1 + K) / (1 + K_c)),

where M_c of the M counted pixels or Gaussians of the view have class c, and K_c of the K keyframes
see it. The square root reduces the weight of large surfaces such as walls.

The paper prints w(c) = M / M_c * log(N / (1 + N_c)), where N_c of the N Gaussians of the submap
have class c. It divides by zero for classes out of view, lets a single stray Gaussian dominate,
counts rarity twice, and depends on how much of a submap has been mapped. `printed_vectors` is this
equation; the weighting "inverse" floors M_c and scales the vectors to unit length.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.slam.loops.options import LandmarkOptions

Array = NDArray[np.float64]
Counts = NDArray[np.integer]


def landmark_vectors(counts: Counts, options: LandmarkOptions | None = None) -> Array:
    """Compute the landmark vectors [K, C] of K keyframes: unit length, or zero if uninformative.

    The weights depend on all K keyframes, so vectors of different calls are not comparable.

    Args:
        counts: [K, C] observed pixels or Gaussians per class, void excluded.
        options: weighting, not "paper"; default if None.
    """
    options = options or LandmarkOptions()
    if options.weighting == "inverse":
        vectors = _inverse_frequencies(counts, options.min_count)
        vectors *= gaussian_idf(counts.sum(axis=0))
    else:
        counts = np.where(counts >= max(1, options.min_count), counts, 0)
        frequencies = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
        if options.weighting == "sqrt":
            frequencies = np.sqrt(frequencies)
        vectors = frequencies * keyframe_idf(counts)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def printed_vectors(counts: Counts, submap_counts: Counts) -> Array:
    """Compute the landmark vectors [K, C] of equation 7 as printed; 0 for classes out of view.

    Args:
        counts: [K, C] observed Gaussians per class.
        submap_counts: [K, C] Gaussians per class in the submap of each keyframe.
    """
    return _inverse_frequencies(counts, floor=1) * gaussian_idf(submap_counts)


def keyframe_idf(counts: Counts) -> Array:
    """log((1 + K) / (1 + K_c)) [C] from counts [K, C]: 0 for classes that all keyframes see."""
    observing = np.count_nonzero(counts, axis=0)
    return np.log((1.0 + len(counts)) / (1.0 + observing))


def gaussian_idf(map_counts: Counts) -> Array:
    """log(N / (1 + N_c)) [..., C] as in G, for N_c Gaussians of class c and N in total."""
    map_counts = np.asarray(map_counts)
    return np.log(np.maximum(1.0, map_counts.sum(axis=-1, keepdims=True)) / (1.0 + map_counts))


def landmark_distance(first: Array, second: Array) -> float | None:
    """Euclidean distance of two vectors [C] of one call; in [0, sqrt 2] for unit vectors.

    None if either vector is zero, that is, if a view shows only classes that all keyframes see.
    """
    if not first.any() or not second.any():
        return None
    return float(np.linalg.norm(first - second))


def _inverse_frequencies(counts: Counts, floor: int) -> Array:
    """M / max(M_c, floor) [K, C] of the visible classes c."""
    observed = counts.sum(axis=1, keepdims=True)
    return np.where(counts > 0, observed / np.maximum(counts, max(1, floor)), 0.0)
