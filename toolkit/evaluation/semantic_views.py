"""Scores what views of a map show against the labels of the data set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.evaluation.calibration import Calibration, calibration_metrics
from toolkit.evaluation.metrics import Metrics
from toolkit.evaluation.segmentation import (
    Segmentation,
    segmentation_conventions,
    segmentation_metrics,
    visible_classes,
)
from toolkit.frame import Frame
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import SurfaceView
from toolkit.semantics.taxonomy import Taxonomy


@dataclass(frozen=True)
class SemanticReading:
    """A map's semantics, and the names of the data set's own labels.

    Attributes:
        semantics: decodes views of the map.
        taxonomy: the map's classes.
        truth_names: class names by id of the data set's labels, without void.
        subset: decode each view a second time among the classes of its true labels alone, for
            the papers' subset mIoU.
    """

    semantics: SemanticMapping
    taxonomy: Taxonomy
    truth_names: Mapping[int, str]
    subset: bool = False

    @property
    def comparable(self) -> bool:
        """Whether the map's tree has every class of the truth."""
        known = {name.casefold() for name in self.taxonomy.classes}
        return bool(self.truth_names) and all(
            name.casefold() in known for name in self.truth_names.values()
        )


class SemanticScores:
    """Collects the scores of one group of views; does nothing without a reading.

    Args:
        reading: what is scored, or None for a map without semantics.
        suffix: of the figures' names, as `segmentation_metrics` takes it.
    """

    def __init__(self, reading: SemanticReading | None, suffix: str = "") -> None:
        self._reading = reading if reading is not None and reading.comparable else None
        self._suffix = suffix
        if self._reading is not None:
            self._table = self._reading.taxonomy.relabelling(self._reading.truth_names)
            self._segmentation = Segmentation(self._reading.taxonomy)
            self.calibration = Calibration()

    @property
    def wanted(self) -> bool:
        """Whether views must be drawn with their features."""
        return self._reading is not None

    def add(self, frame: Frame, drawn: SurfaceView) -> None:
        """Score a drawn view against the frame's own labels, if it has any."""
        if self._reading is None or frame.labels is None:
            return
        truth = self._truth(frame.labels)
        decoding = self._reading.semantics.decode_view(drawn)
        nodes = decoding.nodes.T.reshape(-1, *truth.shape)
        self._segmentation.add(truth, nodes, self._subset(truth, drawn))
        predicted = decoding.class_ids.reshape(truth.shape)
        self.calibration.add(truth, predicted, decoding.confidence.reshape(truth.shape))

    def metrics(self) -> Metrics:
        """Flat figures, empty without semantics or labelled views."""
        if self._reading is None or not self._segmentation.views:
            return {}
        return {
            **segmentation_metrics(self._segmentation, self._suffix),
            **calibration_metrics(self.calibration, self._suffix),
            **segmentation_conventions(self._reading.taxonomy),
        }

    def _subset(self, truth: NDArray[np.int32], drawn: SurfaceView) -> NDArray[np.int32] | None:
        """Class ids [H, W] decoded among the classes of the true labels, if asked for."""
        assert self._reading is not None
        visible = visible_classes(truth)
        if not self._reading.subset or not len(visible):
            return None
        return self._reading.semantics.decode_view(drawn, visible).class_ids.reshape(truth.shape)

    def _truth(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """Class ids of the map's tree; ids without a name are void."""
        named = (labels >= 0) & (labels < len(self._table))
        return np.maximum(self._table[np.where(named, labels, 0)], 0)
