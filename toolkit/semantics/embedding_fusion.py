"""Fusion of the embeddings of one object over its views, robust against wrong views.

Some views show another object: the mask was wrong, or the views were associated wrongly. These
embeddings agree less with the others. The result is the weighted mean of the views that agree,
found by iteration from the half of the views that agrees best (as least trimmed squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.io.object_embeddings import unit_rows

Array = NDArray[np.float64]

_MAX_ITERATIONS = 20
_MIN_NORM = 1e-9
# Standard deviation of a normal distribution over its median absolute deviation.
_SIGMA_PER_MAD = 1.4826


@dataclass(frozen=True)
class FusionOptions:
    """Options of the fusion.

    Attributes:
        robust: leave out views that disagree; otherwise, the weighted mean of all is returned.
        max_deviations: views are left out if their similarity to the others is below the median
            similarity of the used views by more than this many (robust) standard deviations.
        min_spread: minimum of that standard deviation, so that views which agree almost perfectly
            do not exclude each other.
    """

    robust: bool = True
    max_deviations: float = 2.5
    min_spread: float = 0.01


@dataclass(frozen=True)
class FusedEmbedding:
    """The embedding of an object.

    Attributes:
        embedding: [D] float32, unit length.
        weight: sum of the weights of the views that it was fused from.
        used: [V] whether each view was used.
        agreement: weighted mean of the similarities of the used views to the result, in [-1, 1].
    """

    embedding: NDArray[np.float32]
    weight: float
    used: NDArray[np.bool_]
    agreement: float


def view_weights(
    areas_px: NDArray[np.floating],
    distances_m: NDArray[np.floating],
    scores: NDArray[np.floating] | None = None,
    full_area_px: float = 64.0**2,
    full_distance_m: float = 1.0,
) -> Array:
    """Return the weights [V] of views, in [0, 1].

    The weight is the score times the fourth root of the product of the area relative to
    `full_area_px`, beyond which more pixels add no detail that an encoder sees, and of
    `full_distance_m` over the distance, at most 1. Without the root, one near view would outweigh
    all others, and an object would be lost if that view is wrong.

    Args:
        areas_px: [V] visible area of the object, in pixels.
        distances_m: [V] distance from the camera, in metres.
        scores: [V] confidence of the mask, in [0, 1]; 1 by default.
        full_area_px: area that has the full weight.
        full_distance_m: distance up to which views have the full weight.

    Raises:
        ValueError: a value is negative or not finite, or a score exceeds 1.
    """
    scores = np.ones(len(areas_px)) if scores is None else scores
    for name, values in (("areas", areas_px), ("distances", distances_m), ("scores", scores)):
        if not np.isfinite(values).all() or (values < 0).any():
            raise ValueError(f"{name} must be finite and not negative")
    if (scores > 1).any():
        raise ValueError("scores must be at most 1")
    area = np.minimum(areas_px / full_area_px, 1.0)
    near = np.minimum(full_distance_m / np.maximum(distances_m, full_distance_m), 1.0)
    return np.asarray(scores * (area * near) ** 0.25, np.float64)


def fuse_views(
    embeddings: NDArray[np.floating],
    weights: NDArray[np.floating] | None = None,
    options: FusionOptions | None = None,
) -> FusedEmbedding | None:
    """Fuse the embeddings of the views of one object.

    The result is deterministic. It does not depend on the order of the views, except where two
    views agree equally well with the others.

    Args:
        embeddings: [V, D]; they are scaled to unit length.
        weights: [V] not negative; 1 by default. Views of weight 0 are not used.
        options: options of the fusion.

    Returns:
        The fused embedding, None if all weights or all embeddings are zero.

    Raises:
        ValueError: shapes do not fit, a value is not finite, or a weight is negative.
    """
    options = options or FusionOptions()
    if weights is None:
        weights = np.ones(len(embeddings))
    if embeddings.ndim != 2 or weights.shape != embeddings.shape[:1]:
        raise ValueError(
            f"embeddings [V, D] and weights [V] expected, got {list(embeddings.shape)} and "
            f"{list(weights.shape)}"
        )
    if not (np.isfinite(embeddings).all() and np.isfinite(weights).all()) or (weights < 0).any():
        raise ValueError("embeddings and weights must be finite, and weights not negative")
    vectors = unit_rows(embeddings).astype(np.float64)
    weights = np.where(np.any(vectors, axis=1), weights, 0.0)
    used = weights > 0
    if not used.any():
        return None
    if options.robust and used.sum() > 2:  # of two views, either can be the wrong one
        used = _agreeing(vectors, weights.astype(np.float64), options)
    mean = (weights[used, None] * vectors[used]).sum(axis=0)
    norm = np.linalg.norm(mean)
    if norm < _MIN_NORM:  # the views cancel each other out
        return None
    centre = mean / norm
    agreement = float(np.average(vectors[used] @ centre, weights=weights[used]))
    return FusedEmbedding(centre.astype(np.float32), float(weights[used].sum()), used, agreement)


def _agreeing(vectors: Array, weights: Array, options: FusionOptions) -> NDArray[np.bool_]:
    """Return which views [V] agree; each view with a weight has one vote.

    The similarity of a view is that to the mean of the other used views: its own noise would make
    it similar to a mean that contains it.
    """
    voters = np.flatnonzero(weights > 0)
    vectors = vectors[voters]
    used = _most_agreeing_half(vectors)
    for _ in range(_MAX_ITERATIONS):
        others = (used @ vectors) - used[:, None] * vectors
        similarities = (vectors * unit_rows(others)).sum(axis=1)
        middle = np.median(similarities[used])
        spread = _SIGMA_PER_MAD * np.median(np.abs(similarities[used] - middle))
        limit = middle - options.max_deviations * max(float(spread), options.min_spread)
        before, used = used, similarities >= limit
        if (used == before).all():
            break
    agreeing = np.zeros(len(weights), bool)
    agreeing[voters[used]] = True
    return agreeing


def _most_agreeing_half(vectors: Array) -> NDArray[np.bool_]:
    """Return the half of the views [V] with the greatest median similarity to the others.

    As long as more than half of the views are right, wrong ones have small medians, even if they
    all show the same other object.
    """
    similarities = vectors @ vectors.T
    np.fill_diagonal(similarities, np.nan)
    medians = np.nanmedian(similarities, axis=1)
    chosen = np.zeros(len(vectors), bool)
    chosen[np.argsort(-medians, kind="stable")[: len(vectors) // 2 + 1]] = True
    return chosen
