"""Evidence for the relative pose of two keyframes that dense alignment did not use.

Dense alignment minimises residuals of colour and depth together. In a fast turn, colour and depth
of a frame were taken at different times, and the shutter of either may have been rolling. The
minimum then lies between the two, several degrees from what the images show, and it is the same in
both directions of alignment. Correlation of the images sees it: it was higher at the pose of the
matched features, before depth moved it. Of bent images, blocks remain displaced at every pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel
from toolkit.splatting.alignment.displacement import displacement_rad
from toolkit.splatting.alignment.levels import keyframe_level, limited_to_width, model_level
from toolkit.splatting.alignment.similarity import Similarity, aligned_correlation

Array = NDArray[np.float64]

# Blocks of about 13 pixels: a few pixels of displacement lower the correlation of most textures.
_MAX_WIDTH = 170
# Keyframes whose images are kept: a query is compared with several matches.
_KEPT = 8


@dataclass(frozen=True)
class PairEvidence:
    """Similarity of two keyframes at their relative pose, in both directions.

    Attributes:
        aligned: at the pose of dense alignment, the second keyframe in the first and reversed.
        matched: the same at the pose of the matched features.
        displacements_rad: displacement of image blocks that remains at the aligned pose.
    """

    aligned: tuple[Similarity, Similarity]
    matched: tuple[Similarity, Similarity]
    displacements_rad: tuple[float, float]

    @property
    def correlation(self) -> float:
        """Correlation at the aligned pose, in the worse direction; NaN without texture."""
        found = [view.correlation for view in self.aligned if view.blocks > 0]
        return min(found, default=float("nan"))

    @property
    def lost_correlation(self) -> float:
        """By how much dense alignment lowered the correlation; 0 without texture."""
        losses = [
            before.correlation - after.correlation
            for before, after in zip(self.matched, self.aligned, strict=True)
            if before.blocks > 0 and after.blocks > 0
        ]
        return max(losses, default=0.0)

    @property
    def displacement_rad(self) -> float:
        """Displacement of image blocks in the worse direction; NaN without texture."""
        return max(
            (value for value in self.displacements_rad if value == value), default=float("nan")
        )

    def values(self) -> dict[str, float | None]:
        """What loops.jsonl records."""
        values = {
            "correlation": self.correlation,
            "lost_correlation": self.lost_correlation,
            "displacement_rad": self.displacement_rad,
        }
        return {name: value if value == value else None for name, value in values.items()}


class EvidenceCollector:
    """Compares keyframes at given relative poses; keeps the images of those it used last."""

    def __init__(self) -> None:
        self._levels: LruCache[tuple[FrameLevel, ModelLevel]] = LruCache(_KEPT)

    def of(
        self, first: Keyframe, second: Keyframe, T_aligned: Array, T_matched: Array
    ) -> PairEvidence:
        """Compare two keyframes.

        Args:
            T_aligned, T_matched: T_first_second [4, 4] of dense alignment and of features.
        """
        (a, model_a), (b, model_b) = self._of(first), self._of(second)
        aligned, matched = (
            (aligned_correlation(model_a, b, T), aligned_correlation(model_b, a, se3.inverse(T)))
            for T in (T_aligned, T_matched)
        )
        displacements_rad = (
            displacement_rad(model_a, b, T_aligned),
            displacement_rad(model_b, a, se3.inverse(T_aligned)),
        )
        return PairEvidence(aligned, matched, displacements_rad)

    def _of(self, keyframe: Keyframe) -> tuple[FrameLevel, ModelLevel]:
        # Keyframes of different runs may have the same number, so that objects are compared.
        return self._levels.get(id(keyframe), lambda: _levels(keyframe), (keyframe,))


def _levels(keyframe: Keyframe) -> tuple[FrameLevel, ModelLevel]:
    """A keyframe as a frame and as a model, at a small size."""
    level = limited_to_width(keyframe_level(keyframe), _MAX_WIDTH)
    return level, model_level(level)
