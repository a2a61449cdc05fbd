"""Accuracy and mIoU of predicted labels at every level of the taxonomy.

A confusion matrix contains [K + 1, K + 1] pixel counts with ground truth in rows and prediction in
columns; row and column 0 are void. The intersection over union (IoU) of a class is the number of
its correct pixels divided by the number of pixels with this class in ground truth or prediction.

Without void (the default), pixels whose ground truth is void are ignored, and a prediction of void
at other pixels is an error. With void, void is an additional class. mIoU is the mean over the
classes of the ground truth; "union" is the mean over the classes of ground truth or prediction,
for which a single wrong pixel of an absent class counts as much as a missed class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.runs.evaluation.images import mean_or_none
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.semantics.taxonomy import VOID, Taxonomy

Counts = NDArray[np.int64]

SEGMENTATION_CONVENTIONS: Metrics = {
    "miou": (
        "one confusion matrix over all views; pixels whose truth is void are left out, "
        "predicted void is a miss; mean over the classes of the truth; leaves of the tree "
        "unless a level is named"
    ),
    "miou_union": "the same, mean over classes that truth or prediction has",
    "miou_with_void": "the same with void as a class of its own, on all pixels",
    "miou_per_view": "mean over views of each view's own union mIoU, without void",
    "miou_visible": (
        "mean over views of the mean IoU over the classes in the view's truth; wrongly "
        "predicted classes are no part of the mean"
    ),
    "miou_subset": (
        "Hier-SLAM++'s 'subset': the same, with predictions decoded among the classes of the "
        "view's truth alone, which is impossible without the truth; null unless evaluated with "
        "--subset"
    ),
    "fwiou": "IoU weighted by each class's share of the true pixels",
}


@dataclass(frozen=True)
class SegmentationScore:
    """Metrics of one confusion matrix, in [0, 1]; None without evaluated pixels.

    Attributes:
        miou: mean IoU over the classes of the ground truth.
        miou_union: mean IoU over the classes of ground truth or prediction.
        accuracy: fraction of correctly predicted pixels.
        fwiou: frequency-weighted IoU, by the number of ground-truth pixels of each class.
        classes: number of classes of the ground truth.
        pixels: number of evaluated pixels.
    """

    miou: float | None
    miou_union: float | None
    accuracy: float | None
    fwiou: float | None
    classes: int
    pixels: int


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one view, in [0, 1]; None if its ground truth is void everywhere.

    Attributes:
        miou: union mIoU at each level, without void.
        visible: mIoU over the classes in the view's ground truth.
        subset: the same for predictions decoded among these classes only; None unless given.
    """

    miou: tuple[float | None, ...]
    visible: float | None
    subset: float | None


def confusion(truth: NDArray[np.integer], predicted: NDArray[np.integer], classes: int) -> Counts:
    """Compute the confusion matrix [K + 1, K + 1] of two images of ids 0..K.

    Raises:
        ValueError: shapes differ, or an id is not within 0..K.
    """
    if truth.shape != predicted.shape:
        raise ValueError(
            f"truth and prediction must have the same shape, got {list(truth.shape)} and "
            f"{list(predicted.shape)}"
        )
    _check_ids("truth", truth, 0, classes)
    _check_ids("predicted", predicted, 0, classes)
    side = classes + 1
    pairs = truth.astype(np.int64).ravel() * side + predicted.ravel()
    return np.bincount(pairs, minlength=side * side).reshape(side, side).astype(np.int64)


def class_iou(counts: Counts, with_void: bool = False) -> NDArray[np.float64]:
    """Compute the IoU [K + 1] of each class, void first; NaN for absent classes.

    Args:
        counts: a confusion matrix.
        with_void: whether void is a class; otherwise its entry is NaN.
    """
    evaluated = _evaluated(counts, with_void)
    intersection = np.diagonal(evaluated).astype(np.float64)
    union = evaluated.sum(axis=0) + evaluated.sum(axis=1) - intersection
    iou = np.full(len(counts), np.nan)
    np.divide(intersection, union, out=iou, where=union > 0)
    if not with_void:
        iou[VOID] = np.nan
    return iou


def score(counts: Counts, with_void: bool = False) -> SegmentationScore:
    """Compute the metrics of a confusion matrix, without or with void as a class."""
    evaluated = _evaluated(counts, with_void)
    pixels = int(evaluated.sum())
    iou = class_iou(counts, with_void)
    in_union = np.isfinite(iou)
    in_truth = in_union & (evaluated.sum(axis=1) > 0)
    if pixels == 0:
        return SegmentationScore(None, None, None, None, 0, 0)
    frequency = evaluated.sum(axis=1) / pixels
    return SegmentationScore(
        miou=float(iou[in_truth].mean()),
        miou_union=float(iou[in_union].mean()),
        accuracy=float(np.diagonal(evaluated).sum() / pixels),
        fwiou=float((frequency[in_truth] * iou[in_truth]).sum()),
        classes=int(in_truth.sum()),
        pixels=pixels,
    )


def visible_classes(truth: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the class ids in the ground truth of one view, without void."""
    return np.flatnonzero(np.bincount(truth.ravel())[1:]) + 1


class Segmentation:
    """Accumulates label predictions and ground truth over a sequence of views.

    Args:
        taxonomy: taxonomy of ground truth and prediction.

    Attributes:
        views: metrics of each view, in order.
    """

    def __init__(self, taxonomy: Taxonomy) -> None:
        self.taxonomy = taxonomy
        self.views: list[ViewScore] = []
        # For each level: node index to class number 1..K of the level, void (-1) as last entry.
        self._tables = [_level_table(taxonomy, level) for level in range(taxonomy.depth)]
        sizes = [len(taxonomy.nodes_at(level)) + 1 for level in range(taxonomy.depth)]
        self._counts = [np.zeros((size, size), np.int64) for size in sizes]

    def add(
        self,
        truth: NDArray[np.integer],
        predicted: NDArray[np.integer],
        subset: NDArray[np.integer] | None = None,
    ) -> ViewScore:
        """Add one view.

        Args:
            truth: class ids [H, W], 0 void.
            predicted: class ids [H, W], 0 void; or node indices at each level [L, H, W],
                -1 void.
            subset: class ids [H, W] decoded among `visible_classes(truth)` only.

        Raises:
            ValueError: shapes differ, or an id is not in the taxonomy.
        """
        truths = self._all_levels(truth)
        counts = [
            confusion(table[true], _class_numbers(nodes, table, level), len(total) - 1)
            for level, (true, nodes, table, total) in enumerate(
                zip(truths, self._all_levels(predicted), self._tables, self._counts, strict=True)
            )
        ]
        subset_miou = None
        if subset is not None:
            subset_miou = _truth_miou(confusion(truth, subset, len(self.taxonomy)))
        for total, view_counts in zip(self._counts, counts, strict=True):
            total += view_counts
        mious = tuple(score(view_counts).miou_union for view_counts in counts)
        self.views.append(ViewScore(mious, _truth_miou(counts[-1]), subset_miou))
        return self.views[-1]

    def counts(self, level: int | None = None) -> Counts:
        """Return the confusion matrix over all views at a level, the finest if None.

        Rows and columns are void followed by `taxonomy.nodes_at(level)`.
        """
        return self._counts[-1 if level is None else level].copy()

    def _all_levels(self, ids: NDArray[np.integer]) -> Sequence[NDArray[np.integer]]:
        """Return node indices [H, W] at each level, from class ids or node indices."""
        taxonomy = self.taxonomy
        if ids.ndim == 2:
            _check_ids("class ids", ids, 0, len(taxonomy))
            return [taxonomy.level_ids(ids, level) for level in range(taxonomy.depth)]
        if len(ids) != taxonomy.depth:
            raise ValueError(
                f"predicted must have shape [{taxonomy.depth}, H, W] or [H, W], "
                f"got {list(ids.shape)}"
            )
        _check_ids("node indices", ids, -1, len(taxonomy.nodes) - 1)
        return list(ids)


def segmentation_metrics(result: Segmentation) -> Metrics:
    """Compute all metrics of a group of views in percent, and a group for each level of the tree.

    Args:
        result: predictions over all views; all metrics are None without views.
    """
    finest = result.counts()
    leaf, with_void = score(finest), score(finest, with_void=True)
    return {
        **_percent(
            miou=leaf.miou,
            miou_union=leaf.miou_union,
            accuracy=leaf.accuracy,
            fwiou=leaf.fwiou,
            miou_with_void=with_void.miou,
            accuracy_with_void=with_void.accuracy,
            fwiou_with_void=with_void.fwiou,
            miou_per_view=mean_or_none([view.miou[-1] for view in result.views]),
            miou_visible=mean_or_none([view.visible for view in result.views]),
            miou_subset=mean_or_none([view.subset for view in result.views]),
            labelled=leaf.pixels / finest.sum() if finest.any() else None,
        ),
        "views": len(result.views),
        "classes": leaf.classes,
        **{f"level_{n}": _level_metrics(result, n) for n in range(result.taxonomy.depth)},
    }


def _level_metrics(result: Segmentation, level: int) -> Metrics:
    at_level = score(result.counts(level))
    per_view = mean_or_none([view.miou[level] for view in result.views])
    return _percent(miou=at_level.miou, accuracy=at_level.accuracy, miou_per_view=per_view)


def _percent(**fractions: float | None) -> Metrics:
    return {
        f"{name}_percent": None if fraction is None else 100.0 * fraction
        for name, fraction in fractions.items()
    }


def _check_ids(name: str, ids: NDArray[np.integer], low: int, high: int) -> None:
    if ids.size and (ids.min() < low or ids.max() > high):
        raise ValueError(
            f"{name} must be within {low}..{high}, got {int(ids.min())}..{int(ids.max())}"
        )


def _evaluated(counts: Counts, with_void: bool) -> Counts:
    """Return the counts of the evaluated pixels."""
    if with_void:
        return counts
    evaluated = counts.copy()
    evaluated[VOID] = 0
    return evaluated


def _truth_miou(counts: Counts) -> float | None:
    """Compute the mIoU over the classes of the ground truth, without void."""
    in_truth = counts.sum(axis=1) > 0
    in_truth[VOID] = False
    return float(class_iou(counts)[in_truth].mean()) if in_truth.any() else None


def _level_table(taxonomy: Taxonomy, level: int) -> NDArray[np.int32]:
    """Return a table [M + 1] from node index to class number 1..K of a level.

    Nodes of other levels are -1; the last entry is void.
    """
    table = np.full(len(taxonomy.nodes) + 1, -1, np.int32)
    present = np.unique(taxonomy.node_ids[:, level])
    table[present] = np.arange(1, len(present) + 1)
    table[-1] = VOID
    return table


def _class_numbers(
    nodes: NDArray[np.integer], table: NDArray[np.int32], level: int
) -> NDArray[np.int32]:
    numbers = table[nodes]
    if (numbers < 0).any():
        raise ValueError(f"predicted contains nodes that are not at level {level}")
    return numbers
