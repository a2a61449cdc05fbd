"""Evaluation of instances against true ones: panoptic quality, average precision, and errors.

Both are numbers of objects of the same points, for example of the Gaussians of a map. Panoptic
quality (Kirillov et al., 2019) and average precision do not depend on classes here: an object is
right if its points are those of a true object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Intersection over union from which a predicted object is a true one in panoptic quality.
_SAME = 0.5
# Fraction of a true object from which a predicted part of it is an error of association, and
# minimum number of points.
_ERROR_SHARE, _ERROR_POINTS = 0.1, 20


@dataclass(frozen=True)
class InstanceScores:
    """Scores of instances; fractions are in [0, 1].

    Attributes:
        pq: panoptic quality, the product of `sq`, the mean intersection over union of the objects
            that were found, and `rq`, the F1 score of finding them.
        sq, rq: see `pq`.
        ap25, ap50: average precision with a minimum intersection over union of 0.25 and 0.5.
        predicted, true: numbers of objects.
        split: true objects of which several predicted ones show a part, and little else.
        merged: predicted objects that contain most of several true ones.
    """

    pq: float
    sq: float
    rq: float
    ap25: float
    ap50: float
    predicted: int
    true: int
    split: int
    merged: int


def instance_scores(
    predicted: NDArray[np.integer], truth: NDArray[np.integer], min_points: int = 20
) -> InstanceScores:
    """Compare predicted with true objects; those with more points count as more confident.

    Args:
        predicted: [N] predicted object of each point, 0 for none.
        truth: [N] true object of each point; points with 0 are ignored.
        min_points: smaller true objects are ignored, and so are the points on them.
    """
    sizes = np.bincount(truth, minlength=1)
    known = (truth > 0) & (sizes[truth] >= min_points)
    overlaps = _Overlaps.of(predicted[known], truth[known])
    iou = overlaps.iou()
    same = iou > _SAME  # at most one in each row and column
    found = float(same.sum())
    sq = float(iou[same].mean()) if found else 0.0
    rq = found / max(0.5 * sum(iou.shape), 1e-9)
    order = np.argsort(-overlaps.predicted_sizes, kind="stable")
    split, merged = overlaps.errors()
    return InstanceScores(
        sq * rq,
        sq,
        rq,
        _average_precision(iou[order], 0.25),
        _average_precision(iou[order], 0.5),
        len(iou),
        iou.shape[1],
        split,
        merged,
    )


@dataclass(frozen=True, eq=False)
class _Overlaps:
    """Shared points [P, T] of predicted and true objects, and the points of each."""

    shared: NDArray[np.int64]
    predicted_sizes: NDArray[np.int64]
    true_sizes: NDArray[np.int64]

    @classmethod
    def of(cls, predicted: NDArray[np.integer], truth: NDArray[np.integer]) -> _Overlaps:
        found, rows = np.unique(predicted, return_inverse=True)
        true, columns = np.unique(truth, return_inverse=True)
        cells = rows.reshape(-1) * len(true) + columns.reshape(-1)
        table = np.bincount(cells, minlength=len(found) * len(true))
        table = table.reshape(len(found), len(true))
        true_sizes = table.sum(axis=0)
        objects = found > 0
        shared = table[objects]
        return cls(shared, shared.sum(axis=1), true_sizes)

    def iou(self) -> NDArray[np.float64]:
        union = self.predicted_sizes[:, None] + self.true_sizes - self.shared
        return np.asarray(self.shared / np.maximum(union, 1), np.float64)

    def errors(self) -> tuple[int, int]:
        """Numbers of true objects that are split, and of predicted ones that are merged."""
        large = self.shared >= _ERROR_POINTS
        split = large & (self.shared >= _ERROR_SHARE * self.true_sizes)
        split &= self.shared >= _SAME * self.predicted_sizes[:, None]
        merged = large & (self.shared >= _SAME * self.true_sizes)
        return int((split.sum(axis=0) >= 2).sum()), int((merged.sum(axis=1) >= 2).sum())


def _average_precision(iou: NDArray[np.float64], minimum: float) -> float:
    """Area below the precision, made monotonic, over recall.

    Args:
        iou: [P, T] of predicted objects, the most confident first, and true ones.
    """
    predicted, true = iou.shape
    if not predicted or not true:
        return 0.0
    free = np.ones(true, bool)
    right = np.zeros(predicted, bool)
    for row in range(predicted):
        candidates = np.where(free, iou[row], 0.0)
        best = int(candidates.argmax())
        if candidates[best] >= minimum:
            right[row], free[best] = True, False
    found = np.cumsum(right)
    precision = found / np.arange(1, predicted + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    return float((precision * right).sum() / true)
