"""Calibration of the predicted confidence: of all pixels at 80 %, 80 % should be correct."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.runs.evaluation.metrics import Metrics
from toolkit.semantics.taxonomy import VOID

_BINS = 15  # as in Guo et al., "On calibration of modern neural networks" (2017)


@dataclass(frozen=True)
class ReliabilityTable:
    """Confidence and accuracy in bins of equal width over [0, 1].

    Attributes:
        pixels: [B] int64 number of pixels in each bin.
        confidence: [B] mean confidence of the pixels, NaN for an empty bin.
        accuracy: [B] fraction of correct pixels, NaN for an empty bin.
    """

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


class Calibration:
    """Accumulates confidence and correctness over a sequence of views."""

    def __init__(self) -> None:
        self._pixels = np.zeros(_BINS, np.int64)
        self._confidence = np.zeros(_BINS)
        self._correct = np.zeros(_BINS, np.int64)
        self._labelled_pixels = 0

    def add(
        self,
        truth: NDArray[np.integer],
        predicted: NDArray[np.integer],
        confidence: NDArray[np.floating],
    ) -> None:
        """Add one view.

        Args:
            truth, predicted: class ids [H, W].
            confidence: [H, W] in [0, 1], of the prediction.
        """
        self._labelled_pixels += int((truth != VOID).sum())
        valid = (truth != VOID) & (predicted != VOID)
        values = confidence[valid].astype(np.float64)
        # Bins include their upper bound; the first bin also includes its lower bound.
        index = np.clip(np.ceil(values * _BINS).astype(int) - 1, 0, _BINS - 1)
        correct = (truth == predicted)[valid]
        self._pixels += np.bincount(index, minlength=_BINS)
        self._confidence += np.bincount(index, weights=values, minlength=_BINS)
        self._correct += np.bincount(index[correct], minlength=_BINS)

    @property
    def table(self) -> ReliabilityTable:
        """Reliability table of all views added so far."""
        with np.errstate(invalid="ignore"):
            return ReliabilityTable(
                self._pixels.copy(),
                self._confidence / self._pixels,
                self._correct / self._pixels,
            )

    @property
    def coverage(self) -> float | None:
        """Fraction of the labelled pixels that have a prediction, None without labels."""
        if self._labelled_pixels == 0:
            return None
        return float(self._pixels.sum() / self._labelled_pixels)


def calibration_metrics(result: Calibration) -> Metrics:
    """Compute ECE, mean confidence and coverage of views in percent; None without data."""
    table = result.table
    total = int(table.pixels.sum())
    mean = np.nansum(table.confidence * table.pixels) / total if total else None
    values = {"ece": table.ece, "confidence_mean": mean, "calibration_coverage": result.coverage}
    return {
        f"{name}_percent": None if value is None else float(100.0 * value)
        for name, value in values.items()
    }
