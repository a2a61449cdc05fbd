"""How well labels are predicted, at every level of the semantic tree.

A confusion matrix is [K + 1, K + 1] counts of pixels, truth in rows and prediction in
columns; row and column 0 are void. Intersection over union of a class is its hits over all
pixels that have it in truth or prediction.

Without void (the usual figures), pixels whose truth is void are left out, and a prediction
of void elsewhere is a miss. With void, void is one more class. The mean is over the classes
that the truth has; "union" means those that truth or prediction has, where one pixel of a
class that is not there costs as much as a whole class missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.evaluation.images import mean_or_none
from toolkit.evaluation.metrics import Metrics
from toolkit.semantics.taxonomy import VOID, Taxonomy

Counts = NDArray[np.int64]

_CONVENTIONS: Metrics = {
    "miou_convention": (
        "one confusion matrix over all views; pixels whose truth is void are left out, "
        "predicted void is a miss; mean over the classes of the truth; leaves of the tree "
        "unless a level is named"
    ),
    "miou_union_convention": "the same, mean over classes that truth or prediction has",
    "miou_with_void_convention": "the same with void as a class of its own, on all pixels",
    "miou_per_view_convention": "mean over views of each view's own union mIoU, without void",
    "miou_visible_convention": (
        "mean over views of the mean IoU over the classes in the view's truth; wrongly "
        "predicted classes are no part of the mean"
    ),
    "miou_subset_convention": (
        "Hier-SLAM++'s 'subset': the same, with predictions decoded among the classes of the "
        "view's truth alone, which is impossible without the truth; null unless evaluated with "
        "--subset"
    ),
    "fwiou_convention": "IoU weighted by each class's share of the true pixels",
}


@dataclass(frozen=True)
class SegmentationScore:
    """Figures of one confusion matrix, in [0, 1]; None where there is no pixel to score.

    Attributes:
        miou: mean over the classes that the truth has.
        miou_union: mean over the classes that truth or prediction has.
        accuracy: share of pixels predicted right.
        fwiou: IoU weighted by the classes' share of the truth.
        classes: how many the mean is over.
        pixels: how many were scored.
    """

    miou: float | None
    miou_union: float | None
    accuracy: float | None
    fwiou: float | None
    classes: int
    pixels: int


@dataclass(frozen=True)
class ViewScore:
    """Figures of one view, in [0, 1]; None where its truth is void everywhere.

    Attributes:
        miou: at each level, without void.
        visible: over the classes in the view's truth.
        subset: the same for predictions decoded among these classes alone; None unless given.
    """

    miou: tuple[float | None, ...]
    visible: float | None
    subset: float | None


def confusion(truth: NDArray[np.integer], predicted: NDArray[np.integer], classes: int) -> Counts:
    """Counts [K + 1, K + 1] of two images of ids 0..K, truth in rows.

    Raises:
        ValueError: shapes differ, or an id is not within 0..K.
    """
    if truth.shape != predicted.shape:
        raise ValueError(
            f"truth and prediction must have one shape, got {list(truth.shape)} and "
            f"{list(predicted.shape)}"
        )
    _check_ids("truth", truth, 0, classes)
    _check_ids("predicted", predicted, 0, classes)
    side = classes + 1
    pairs = truth.astype(np.int64).ravel() * side + predicted.ravel()
    return np.bincount(pairs, minlength=side * side).reshape(side, side).astype(np.int64)


def class_iou(counts: Counts, with_void: bool = False) -> NDArray[np.float64]:
    """IoU [K + 1] of each class, NaN for those that appear nowhere; void's is [0].

    Args:
        counts: a confusion matrix.
        with_void: whether void is a class; otherwise its entry is NaN.
    """
    scored = _scored(counts, with_void)
    hits = np.diagonal(scored).astype(np.float64)
    union = scored.sum(axis=0) + scored.sum(axis=1) - hits
    iou = np.full(len(counts), np.nan)
    np.divide(hits, union, out=iou, where=union > 0)
    if not with_void:
        iou[VOID] = np.nan
    return iou


def score(counts: Counts, with_void: bool = False) -> SegmentationScore:
    """The figures of a confusion matrix, without or with void as a class."""
    scored = _scored(counts, with_void)
    pixels = int(scored.sum())
    iou = class_iou(counts, with_void)
    appears = np.isfinite(iou)
    true = appears & (scored.sum(axis=1) > 0)
    if pixels == 0:
        return SegmentationScore(None, None, None, None, 0, 0)
    shares = scored.sum(axis=1) / pixels
    return SegmentationScore(
        miou=float(iou[true].mean()),
        miou_union=float(iou[appears].mean()),
        accuracy=float(np.diagonal(scored).sum() / pixels),
        fwiou=float((shares[true] * iou[true]).sum()),
        classes=int(true.sum()),
        pixels=pixels,
    )


def visible_classes(truth: NDArray[np.integer]) -> NDArray[np.intp]:
    """The class ids, without void, of one view's truth: what "subset" decodes among."""
    return np.flatnonzero(np.bincount(truth.ravel())[1:]) + 1


class Segmentation:
    """Label predictions against the truth, over a sequence of views.

    Args:
        taxonomy: the tree of truth and prediction.

    Attributes:
        views: each view's own figures, in order.
    """

    def __init__(self, taxonomy: Taxonomy) -> None:
        self.taxonomy = taxonomy
        self.views: list[ViewScore] = []
        # Per level: from node indices to 1..K of that level, with void (-1) in the last place.
        self._tables = [_numbering(taxonomy, level) for level in range(taxonomy.depth)]
        sizes = [len(taxonomy.nodes_at(level)) + 1 for level in range(taxonomy.depth)]
        self._counts = [np.zeros((size, size), np.int64) for size in sizes]

    def add(
        self,
        truth: NDArray[np.integer],
        predicted: NDArray[np.integer],
        subset: NDArray[np.integer] | None = None,
    ) -> ViewScore:
        """Count one view.

        Args:
            truth: class ids [H, W], 0 void.
            predicted: class ids [H, W], 0 void; or node indices at each level [L, H, W],
                -1 void.
            subset: class ids [H, W] decoded among `visible_classes(truth)` alone.

        Raises:
            ValueError: shapes differ, or an id is none of the tree.
        """
        truths = self._all_levels(truth)
        counts = [
            confusion(table[true], _numbered(nodes, table, level), len(total) - 1)
            for level, (true, nodes, table, total) in enumerate(
                zip(truths, self._all_levels(predicted), self._tables, self._counts, strict=True)
            )
        ]
        among = None
        if subset is not None:
            among = _over_truth(confusion(truth, subset, len(self.taxonomy)))
        for total, counted in zip(self._counts, counts, strict=True):
            total += counted
        mious = tuple(score(counted).miou_union for counted in counts)
        self.views.append(ViewScore(mious, _over_truth(counts[-1]), among))
        return self.views[-1]

    def counts(self, level: int | None = None) -> Counts:
        """The confusion matrix over all views at a level, the finest if None.

        Rows and columns are void and then `taxonomy.nodes_at(level)`.
        """
        return self._counts[-1 if level is None else level].copy()

    def _all_levels(self, ids: NDArray[np.integer]) -> Sequence[NDArray[np.integer]]:
        """Node indices [H, W] at each level, of class ids or of what is that already."""
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


def segmentation_metrics(result: Segmentation, suffix: str = "") -> Metrics:
    """All figures in percent, flat: `miou_percent`, `miou_level_0_percent` and so on.

    Args:
        result: what was counted; None everywhere without views.
        suffix: "" for mapped views, "_unseen" for views kept out of the map; it stands
            before the unit.
    """
    taxonomy = result.taxonomy
    finest = result.counts()
    leaf, with_void = score(finest), score(finest, with_void=True)
    per_view = [view.miou[-1] for view in result.views]
    figures: dict[str, float | None] = {
        "miou": leaf.miou,
        "miou_union": leaf.miou_union,
        "accuracy": leaf.accuracy,
        "fwiou": leaf.fwiou,
        "miou_with_void": with_void.miou,
        "accuracy_with_void": with_void.accuracy,
        "fwiou_with_void": with_void.fwiou,
        "miou_per_view": mean_or_none(per_view),
        "miou_visible": mean_or_none([view.visible for view in result.views]),
        "miou_subset": mean_or_none([view.subset for view in result.views]),
        "labelled": leaf.pixels / finest.sum() if finest.any() else None,
    }
    for level in range(taxonomy.depth):
        at_level = score(result.counts(level))
        figures[f"miou_level_{level}"] = at_level.miou
        figures[f"accuracy_level_{level}"] = at_level.accuracy
        figures[f"miou_per_view_level_{level}"] = mean_or_none(
            [view.miou[level] for view in result.views]
        )
    percent: Metrics = {
        f"{name}{suffix}_percent": None if value is None else 100.0 * value
        for name, value in figures.items()
    }
    return {
        **percent,
        f"views_labelled{suffix}": len(result.views),
        f"classes_scored{suffix}": leaf.classes,
    }


def segmentation_conventions(taxonomy: Taxonomy) -> Metrics:
    """What the figures mean, and what each level of the tree is called."""
    names: Metrics = {f"level_{number}_name": name for number, name in enumerate(taxonomy.levels)}
    return _CONVENTIONS | names


def _check_ids(name: str, ids: NDArray[np.integer], low: int, high: int) -> None:
    if ids.size and (ids.min() < low or ids.max() > high):
        raise ValueError(
            f"{name} must be within {low}..{high}, got {int(ids.min())}..{int(ids.max())}"
        )


def _scored(counts: Counts, with_void: bool) -> Counts:
    """The counts that a score is made of."""
    if with_void:
        return counts
    scored = counts.copy()
    scored[VOID] = 0
    return scored


def _over_truth(counts: Counts) -> float | None:
    """Mean IoU over the classes of the truth alone, without void."""
    true = counts.sum(axis=1) > 0
    true[VOID] = False
    return float(class_iou(counts)[true].mean()) if true.any() else None


def _numbering(taxonomy: Taxonomy, level: int) -> NDArray[np.int32]:
    """Table [M + 1] from node index to its number 1..K at a level, -1 for other levels' nodes."""
    table = np.full(len(taxonomy.nodes) + 1, -1, np.int32)
    present = np.unique(taxonomy.node_ids[:, level])
    table[present] = np.arange(1, len(present) + 1)
    table[-1] = VOID
    return table


def _numbered(
    nodes: NDArray[np.integer], table: NDArray[np.int32], level: int
) -> NDArray[np.int32]:
    numbers = table[nodes]
    if (numbers < 0).any():
        raise ValueError(f"predicted holds nodes that no class has at level {level}")
    return numbers
