"""Gives frames labels of one taxonomy, whoever made them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.frame import Frame
from toolkit.semantics.segmenters.segmenter import Segmenter
from toolkit.semantics.taxonomy import VOID, Taxonomy


class Labeller:
    """A segmenter whose answers are translated into a taxonomy.

    Args:
        ignored: class ids of what is to be left out of tracking and mapping (people, say):
            such pixels lose their depth, and nothing is tracked or mapped there.
        source: what to call the segmenter's vocabulary in errors.

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

    @property
    def every_frame(self) -> bool:
        """Whether frames need labels before they are tracked, and not only as keyframes."""
        return bool(self._ignored.any())

    def label(self, frame: Frame, T_map_camera: NDArray[np.float64] | None = None) -> Frame:
        """The frame with labels of the taxonomy, and without depth where it is to be ignored.

        Raises:
            DatasetError: the labels cannot be had.
            FormatError: an id that the segmenter has no name for.
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
        if not self.every_frame:
            return replace(frame, labels=labels)
        ignored = self._ignored[labels]
        return replace(
            frame,
            labels=np.where(ignored, VOID, labels).astype(np.int32),
            depth_m=np.where(ignored, 0.0, frame.depth_m).astype(np.float32),
        )
