"""How much of a view each class takes, and how far two views differ in that (G-III.A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.taxonomy import Taxonomy

Array = NDArray[np.float64]

# What every class counts more than it has, as a share of the picture.
SMOOTHING = 1e-3


def class_histogram(labels: NDArray[np.integer], classes: int | Taxonomy) -> Array:
    """Shares [C] of the classes 1..C among the pixels that have a class.

    Args:
        labels: class ids, any shape; void takes no part.
        classes: C, or the taxonomy that the ids are of.

    Returns:
        non-negative shares with sum 1, or zeros where all is void.

    Raises:
        ValueError: an id is outside 0..C.
    """
    count = len(classes) if isinstance(classes, Taxonomy) else classes
    counts = class_counts(labels, count)[1:].astype(np.float64)
    return counts / max(counts.sum(), 1.0)


def class_counts(class_ids: NDArray[np.integer], classes: int) -> NDArray[np.int64]:
    """Count pixels or Gaussians by class, [C + 1]; the first entry is void.

    Args:
        class_ids: 0..C, 0 void, any shape.
        classes: C.

    Raises:
        ValueError: an id is outside 0..C.
    """
    flat = np.asarray(class_ids).ravel()
    if flat.size and not 0 <= int(flat.min()) <= int(flat.max()) <= classes:
        raise ValueError(f"class ids must lie in 0..{classes}, got {flat.min()}..{flat.max()}")
    return np.bincount(flat, minlength=classes + 1).astype(np.int64)


def smoothed_kl(current: Array, anchor: Array, smoothing: float = SMOOTHING) -> float:
    """Kullback-Leibler divergence KL(current || anchor) of two histograms [C], in nats.

    Both get `smoothing` added to every class and are scaled to sum 1 again, so that a class
    which only one has counts a finite amount: at most log(1 + 1 / smoothing). It is 0 for
    equal histograms and not symmetric. A histogram of zeros (all void) becomes uniform, that
    is, knows nothing.

    Args:
        current, anchor: non-negative, as of `class_histogram`.
        smoothing: > 0, as a share of the picture.

    Raises:
        ValueError: lengths differ, there are no classes, or a value is negative or not finite.
    """
    if smoothing <= 0:
        raise ValueError(f"smoothing must be positive, got {smoothing}")
    p, q = (_smoothed(np.asarray(h, np.float64), smoothing) for h in (current, anchor))
    if p.shape != q.shape:
        raise ValueError(f"histograms must have one length, got {len(p)} and {len(q)}")
    # Rounding can leave a tiny negative number where both are equal.
    return max(0.0, float(np.sum(p * np.log(p / q))))


def _smoothed(histogram: Array, smoothing: float) -> Array:
    if histogram.ndim != 1 or not len(histogram):
        raise ValueError(f"a histogram must have shape [C], C > 0, got {list(histogram.shape)}")
    if not np.isfinite(histogram).all() or histogram.min() < 0:
        raise ValueError("a histogram must be finite and not negative")
    total = histogram.sum()
    shares = histogram / total if total > 0 else histogram
    raised = shares + smoothing
    return np.asarray(raised / raised.sum())
