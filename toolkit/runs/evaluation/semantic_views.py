"""Evaluate the labels of rendered views against the labels of the dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.runs.evaluation.calibration import Calibration, calibration_metrics
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.runs.evaluation.segmentation import (
    SEGMENTATION_CONVENTIONS,
    Segmentation,
    segmentation_metrics,
    visible_classes,
)
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.splatting.rendering import SurfaceView


@dataclass(frozen=True)
class SemanticEvaluation:
    """What is needed to evaluate the labels of a map.

    Attributes:
        semantics: decodes rendered features into classes.
        taxonomy: classes of the map.
        truth_names: class names of the dataset's labels by id, without void.
        subset: decode each view a second time among the classes of its ground-truth labels only,
            for the papers' subset mIoU.
    """

    semantics: SemanticMapping
    taxonomy: Taxonomy
    truth_names: Mapping[int, str]
    subset: bool = False

    @property
    def comparable(self) -> bool:
        """Whether the taxonomy of the map contains every class of the dataset."""
        known = {name.casefold() for name in self.taxonomy.classes}
        return bool(self.truth_names) and all(
            name.casefold() in known for name in self.truth_names.values()
        )


class SemanticScores:
    """Accumulates the semantic metrics of one group of views; empty for maps without semantics.

    Args:
        evaluation: decoder and class names, or None for a map without semantics.
    """

    def __init__(self, evaluation: SemanticEvaluation | None) -> None:
        comparable = evaluation is not None and evaluation.comparable
        self._evaluation = evaluation if comparable else None
        if self._evaluation is not None:
            self._table = self._evaluation.taxonomy.relabelling(self._evaluation.truth_names)
            self._segmentation = Segmentation(self._evaluation.taxonomy)
            self.calibration = Calibration()

    @property
    def needs_features(self) -> bool:
        """Whether views must be rendered with feature channels."""
        return self._evaluation is not None

    def add(self, frame: Frame, rendered: SurfaceView) -> None:
        """Evaluate a rendered view against the labels of the frame, if it has any."""
        if self._evaluation is None or frame.labels is None:
            return
        truth = self._truth(frame.labels)
        decoding = self._evaluation.semantics.decode_view(rendered)
        nodes = decoding.nodes.T.reshape(-1, *truth.shape)
        subset, predicted = self._subset(truth, rendered), decoding.class_ids.reshape(truth.shape)
        confidence = decoding.confidence.reshape(truth.shape)
        if frame.ignored is not None:
            # As an image of one row.
            kept = ~frame.ignored
            truth, predicted, confidence = (
                truth[kept][None],
                predicted[kept][None],
                confidence[kept][None],
            )
            nodes, subset = nodes[:, kept][:, None], None if subset is None else subset[kept][None]
        self._segmentation.add(truth, nodes, subset)
        self.calibration.add(truth, predicted, confidence)

    def metrics(self) -> Metrics:
        """Return the metrics by name; empty without semantics or labelled views."""
        if self._evaluation is None or not self._segmentation.views:
            return {}
        return {
            **segmentation_metrics(self._segmentation),
            **calibration_metrics(self.calibration),
        }

    def _subset(self, truth: NDArray[np.int32], rendered: SurfaceView) -> NDArray[np.int32] | None:
        """Decode class ids [H, W] among the classes of the ground truth, if requested."""
        assert self._evaluation is not None
        visible = visible_classes(truth)
        if not self._evaluation.subset or not len(visible):
            return None
        decoding = self._evaluation.semantics.decode_view(rendered, visible)
        return decoding.class_ids.reshape(truth.shape)

    def _truth(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Map dataset labels to class ids of the taxonomy; ids without a name are void."""
        named = (labels >= 0) & (labels < len(self._table))
        return np.maximum(self._table[np.where(named, labels, 0)], 0)


def semantic_metrics(
    scores: Mapping[str, SemanticScores], evaluation: SemanticEvaluation | None
) -> Metrics:
    """Return the group "semantics", with a group for each group of views that has labels.

    It is missing without semantics or labelled views.
    """
    by_views = {group: metrics for group, score in scores.items() if (metrics := score.metrics())}
    if evaluation is None or not by_views:
        return {}
    names = {f"level_{number}": name for number, name in enumerate(evaluation.taxonomy.levels)}
    return {"semantics": {**by_views, "levels": names, "conventions": SEGMENTATION_CONVENTIONS}}
