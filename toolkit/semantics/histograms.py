"""Class histograms of views and their divergence (G-III.A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.taxonomy import Taxonomy

Array = NDArray[np.float64]

# Fraction of the image that is added to every class.
SMOOTHING = 1e-3


def class_histogram(labels: NDArray[np.integer], classes: int | Taxonomy) -> Array:
    """Return the fraction [C] of each class 1..C among the labelled pixels.

    Args:
        labels: class ids of any shape; void pixels are ignored.
        classes: number of classes C, or the taxonomy of the ids.

    Returns:
        non-negative fractions with sum 1, or zeros if all pixels are void.

    Raises:
        ValueError: an id is outside 0..C.
    """
    count = len(classes) if isinstance(classes, Taxonomy) else classes
    counts = class_counts(labels, count)[1:].astype(np.float64)
    return counts / max(counts.sum(), 1.0)


def class_counts(class_ids: NDArray[np.integer], classes: int) -> NDArray[np.int64]:
    """Count pixels or Gaussians by class, [C + 1]; the first entry is void.

    Args:
        class_ids: class ids 0..C of any shape, 0 is void.
        classes: number of classes C.

    Raises:
        ValueError: an id is outside 0..C.
    """
    flat = np.asarray(class_ids).ravel()
    if flat.size and not 0 <= int(flat.min()) <= int(flat.max()) <= classes:
        raise ValueError(f"class ids must lie in 0..{classes}, got {flat.min()}..{flat.max()}")
    return np.bincount(flat, minlength=classes + 1).astype(np.int64)


def smoothed_kl(current: Array, anchor: Array) -> float:
    """Return the Kullback-Leibler divergence KL(current || anchor) of two histograms [C], in nats.

    `SMOOTHING` is added to every class before normalisation. The divergence is therefore finite
    if a class appears in one histogram only, at most log(1 + 1 / SMOOTHING). It is 0 for equal
    histograms and not symmetric. A histogram of zeros (all void) becomes uniform.

    Args:
        current, anchor: non-negative histograms, as returned by `class_histogram`.
    """
    p, q = (_smoothed(h) for h in (current, anchor))
    # Rounding can give a small negative value for equal histograms.
    return max(0.0, float(np.sum(p * np.log(p / q))))


def _smoothed(histogram: Array) -> Array:
    total = histogram.sum()
    smoothed = (histogram / total if total > 0 else histogram) + SMOOTHING
    return np.asarray(smoothed / smoothed.sum())
