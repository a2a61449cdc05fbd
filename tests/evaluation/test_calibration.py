"""Calibration of confidences: bins, ECE, coverage, and the chart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.runs.evaluation.calibration import Calibration, calibration_metrics


def collected(confidence: np.ndarray, right: np.ndarray) -> Calibration:
    result = Calibration()
    result.add(np.ones(right.shape, int), np.where(right, 1, 2), confidence)
    return result


def binned_error(confidence: np.ndarray, right: np.ndarray, bins: int) -> float:
    """The definition, bin by bin."""
    total = 0.0
    for i in range(bins):
        low, high = i / bins, (i + 1) / bins
        inside = (confidence > low) & (confidence <= high) | ((i == 0) & (confidence == 0))
        if inside.any():
            total += inside.sum() * abs(right[inside].mean() - confidence[inside].mean())
    return total / len(confidence)


@given(st.integers(0, 10_000), st.integers(1, 300))
def test_the_error_is_the_one_of_the_definition(seed, count):
    generator = np.random.default_rng(seed)
    confidence, right = generator.uniform(size=count), generator.uniform(size=count) < 0.6
    table = collected(confidence, right).table
    assert table.ece == pytest.approx(binned_error(confidence, right, 15))
    assert table.pixels.sum() == count


def test_the_error_is_that_of_torchmetrics():
    functional = pytest.importorskip("torchmetrics.functional.classification")
    import torch

    generator = np.random.default_rng(0)
    confidence = generator.uniform(0.5, 1.0, 500).astype(np.float32)
    right = generator.uniform(size=500) < confidence**2
    # Of two classes the confidence is that of the likelier one.
    chosen = torch.from_numpy(np.where(right, confidence, 1.0 - confidence).astype(np.float32))
    scores = torch.stack([chosen, 1.0 - chosen], dim=1)
    expected = functional.multiclass_calibration_error(
        scores, torch.zeros(500, dtype=torch.long), num_classes=2, n_bins=15, norm="l1"
    )
    assert collected(confidence, right).table.ece == pytest.approx(float(expected), abs=1e-6)


def test_true_promises_have_no_error_and_false_ones_have_theirs():
    confidence = np.full(1000, 0.8)
    kept = np.arange(1000) < 800
    assert collected(confidence, kept).table.ece == pytest.approx(0.0, abs=1e-12)
    assert collected(np.ones(1000), kept).table.ece == pytest.approx(0.2)


def test_views_add_up():
    generator = np.random.default_rng(1)
    confidence, right = generator.uniform(size=200), generator.uniform(size=200) < 0.5
    together, apart = collected(confidence, right), Calibration()
    for part in (slice(0, 60), slice(60, 200)):
        apart.add(np.ones_like(right[part], int), np.where(right[part], 1, 2), confidence[part])
    assert apart.table.ece == pytest.approx(together.table.ece)


def test_void_counts_in_the_coverage_alone():
    result = Calibration()
    truth, predicted = np.array([0, 1, 1, 1]), np.array([1, 0, 1, 2])
    # Where there is no prediction, the confidence means nothing.
    result.add(truth, predicted, np.array([0.1, np.nan, 0.75, 0.75]))
    metrics = calibration_metrics(result)
    assert metrics["calibration_coverage_percent"] == pytest.approx(100.0 * 2 / 3)
    assert metrics["ece_percent"] == pytest.approx(25.0)
    assert metrics["confidence_mean_percent"] == pytest.approx(75.0)


def test_without_pixels_there_is_nothing():
    result = Calibration()
    result.add(np.zeros(3, int), np.ones(3, int), np.ones(3))
    assert set(calibration_metrics(result).values()) == {None}
    assert np.isnan(result.table.accuracy).all()


def test_the_table_has_bins_of_equal_width():
    table = collected(np.array([0.95, 0.97, 0.1]), np.array([True, False, True])).table
    assert table.pixels.tolist() == [0, 1, *[0] * 12, 2]
    assert table.confidence[-1] == pytest.approx(0.96)
    assert table.accuracy[-1] == 0.5
