"""Labels frames with the classes of a taxonomy."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.frame import Frame, without_pixels
from toolkit.semantics.segmenters.segmenter import Segmenter
from toolkit.semantics.taxonomy import VOID, Taxonomy


class IgnoredPixels(Protocol):
    """Finds what else is to be ignored in a frame, beside classes of labels."""

    def pixels(self, frame: Frame, ignored: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the pixels [H, W] to ignore, with those of ignored labels [H, W]."""
        ...


class Labeller:
    """A segmenter whose class ids are mapped to those of a taxonomy.

    Args:
        segmenter: labels the pixels.
        taxonomy: tree with all classes of the segmenter.
        ignored: ids of the classes to exclude from tracking and mapping, for instance people;
            the depth of their pixels is removed.
        source: name of the segmenter's vocabulary in errors.

    Attributes:
        others: finds what else is ignored; None for nothing.

    Raises:
        FormatError: the taxonomy lacks a class of the segmenter.
    """

    def __init__(
        self,
        segmenter: Segmenter,
        taxonomy: Taxonomy,
        ignored: Iterable[int] = (),
        source: str = "labels",
    ) -> None:
        self.segmenter, self.taxonomy = segmenter, taxonomy
        self._table = taxonomy.relabelling(segmenter.class_names, source)
        self._ignored = np.zeros(len(taxonomy) + 1, bool)
        self._ignored[list(ignored)] = True
        self._source = source
        self.others: IgnoredPixels | None = None

    @property
    def every_frame(self) -> bool:
        """Whether every frame needs labels before tracking, not only keyframes."""
        return self.others is not None or bool(self._ignored.any())

    @property
    def ignored_classes(self) -> list[str]:
        """Names of the classes to exclude."""
        return [self.taxonomy.classes[i - 1] for i in np.flatnonzero(self._ignored)]

    def without_masks(self) -> Labeller:
        """A labeller of frames without masks, for which only labels say what is ignored."""
        other = copy.copy(self)
        other.others = None
        return other

    def label(self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None) -> Frame:
        """Return the frame with labels of the taxonomy and without depth at ignored pixels.

        Raises:
            DatasetError: the segmenter cannot label the frame.
            FormatError: the segmenter has no name for a class id.
        """
        ids = self.segmenter.segment(frame, T_map_camera)
        known = (ids >= 0) & (ids < len(self._table))
        labels = self._table[np.where(known, ids, VOID)]
        bad = ids[~known | (labels < 0)]
        if bad.size:
            raise FormatError(
                f"{self._source}: frame {frame.index} has class id {int(bad[0])}, which has no "
                "name; add it to classes.json, or mark it as void"
            )
        labelled = replace(frame, labels=labels)
        if frame.ignored is not None:
            labelled = without_pixels(labelled, frame.ignored)
        if not self.every_frame:
            return labelled
        ignored = self._ignored[labels]
        if self.others is not None:
            ignored = self.others.pixels(frame, ignored)
        return without_pixels(labelled, ignored)
