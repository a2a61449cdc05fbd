"""Whether a confidence means what it says: of all pixels at 80 %, 80 % should be right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.evaluation.metrics import Metrics
from toolkit.semantics.taxonomy import VOID

_BINS = 15  # as in Guo et al., "On calibration of modern neural networks" (2017)


@dataclass(frozen=True)
class ReliabilityTable:
    """Confidence against accuracy, by bins of equal width over [0, 1].

    Attributes:
        edges: [B + 1], bounds of the bins.
        pixels: [B] int64, how many fell in each.
        confidence: [B], their mean confidence, NaN where a bin is empty.
        accuracy: [B], the share of them that is right, NaN where a bin is empty.
    """

    edges: NDArray[np.float64]
    pixels: NDArray[np.int64]
    confidence: NDArray[np.float64]
    accuracy: NDArray[np.float64]

    @property
    def ece(self) -> float | None:
        """Expected calibration error in [0, 1]: |accuracy - confidence|, weighted by pixels."""
        total = self.pixels.sum()
        if total == 0:
            return None
        gaps = np.nan_to_num(np.abs(self.accuracy - self.confidence))
        return float((self.pixels * gaps).sum() / total)

    def rows(self) -> list[dict[str, float | int | None]]:
        """The bins as JSON values, null where a bin is empty."""
        return [
            {
                "from": float(low),
                "to": float(high),
                "pixels": int(pixels),
                "confidence": float(confidence) if pixels else None,
                "accuracy": float(accuracy) if pixels else None,
            }
            for low, high, pixels, confidence, accuracy in zip(
                self.edges[:-1],
                self.edges[1:],
                self.pixels,
                self.confidence,
                self.accuracy,
                strict=True,
            )
        ]


class Calibration:
    """Collects confidence and truth over a sequence of views."""

    def __init__(self, bins: int = _BINS) -> None:
        self._edges = np.linspace(0.0, 1.0, bins + 1)
        self._pixels = np.zeros(bins, np.int64)
        self._confidence = np.zeros(bins)
        self._right = np.zeros(bins, np.int64)
        self._with_truth = 0

    def add(
        self,
        truth: NDArray[np.integer],
        predicted: NDArray[np.integer],
        confidence: NDArray[np.floating],
        void: int = VOID,
    ) -> None:
        """Count one view.

        Args:
            truth, predicted: class ids [H, W], or node indices of one level.
            confidence: [H, W] in [0, 1], of the prediction.
            void: the id of void, -1 for node indices.

        Raises:
            ValueError: shapes differ, or a confidence that counts is not within [0, 1].
        """
        if not truth.shape == predicted.shape == confidence.shape:
            raise ValueError(
                "truth, predicted and confidence must have one shape, got "
                f"{list(truth.shape)}, {list(predicted.shape)} and {list(confidence.shape)}"
            )
        self._with_truth += int((truth != void).sum())
        counted = (truth != void) & (predicted != void)
        values = confidence[counted].astype(np.float64)
        # Written so that NaN is refused, too.
        if not ((values >= 0.0) & (values <= 1.0)).all():
            raise ValueError("confidence must be within [0, 1]")
        bins = len(self._pixels)
        # Bins hold their upper bound, the first one its lower one as well.
        which = np.clip(np.ceil(values * bins).astype(int) - 1, 0, bins - 1)
        right = (truth == predicted)[counted]
        self._pixels += np.bincount(which, minlength=bins)
        self._confidence += np.bincount(which, weights=values, minlength=bins)
        self._right += np.bincount(which[right], minlength=bins)

    @property
    def table(self) -> ReliabilityTable:
        """What was collected."""
        with np.errstate(invalid="ignore"):
            return ReliabilityTable(
                self._edges,
                self._pixels.copy(),
                self._confidence / self._pixels,
                self._right / self._pixels,
            )

    @property
    def coverage(self) -> float | None:
        """Share of the pixels with truth that have a prediction, None without truth."""
        return float(self._pixels.sum() / self._with_truth) if self._with_truth else None


def calibration_metrics(result: Calibration, suffix: str = "") -> Metrics:
    """ECE, mean confidence and coverage in percent; None where nothing was collected.

    Args:
        result: what was collected.
        suffix: "" for mapped views, "_unseen" for views kept out of the map.
    """
    table = result.table
    total = int(table.pixels.sum())
    mean = np.nansum(table.confidence * table.pixels) / total if total else None
    figures = {"ece": table.ece, "confidence_mean": mean, "calibration_coverage": result.coverage}
    return {
        f"{name}{suffix}_percent": None if value is None else float(100.0 * value)
        for name, value in figures.items()
    }
