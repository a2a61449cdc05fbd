"""Scores of instances."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.semantics.instance_quality import instance_scores

TRUTH = np.repeat([1, 2, 3], 100)


def test_the_truth_has_the_best_scores_with_any_numbers():
    scores = instance_scores(np.array([0, 7, 4, 9])[TRUTH], TRUTH)
    assert scores.pq == scores.sq == scores.rq == scores.ap25 == scores.ap50 == 1.0
    assert (scores.predicted, scores.true, scores.split, scores.merged) == (3, 3, 0, 0)


def test_two_objects_in_one_are_merged():
    scores = instance_scores(np.array([0, 1, 1, 2])[TRUTH], TRUTH)
    assert (scores.predicted, scores.merged, scores.split) == (2, 1, 0)
    # One of three is found with an IoU of 1: F1 is 1 / (1 + 0.5 + 1).
    assert scores.pq == pytest.approx(0.4)
    # At 0.25, the merged one counts for one of its two objects.
    assert scores.ap25 == pytest.approx(2 / 3)
    assert scores.ap50 == pytest.approx(2 / 3)


def test_an_object_in_two_halves_is_split():
    predicted = TRUTH.copy()
    predicted[40:100] = 8
    scores = instance_scores(predicted, TRUTH)
    assert (scores.split, scores.merged) == (1, 0)
    assert scores.rq == pytest.approx(3 / 3.5)
    assert scores.sq == pytest.approx((1 + 1 + 0.6) / 3)


def test_points_without_a_true_object_do_not_count():
    predicted = np.concatenate([TRUTH, np.full(500, 1)])
    truth = np.concatenate([TRUTH, np.zeros(500, int)])
    assert instance_scores(predicted, truth).pq == 1.0


def test_tiny_true_objects_do_not_count():
    truth = np.concatenate([TRUTH, np.full(5, 4)])
    assert instance_scores(truth, truth).true == 3


def test_large_errors_lower_the_average_precision():
    predicted = TRUTH.copy()
    predicted[:30] = 4
    assert instance_scores(predicted, TRUTH).ap50 == 1.0
    # One of three is found, after a larger object that is none of them.
    predicted = np.where(np.arange(300) < 240, 1, 2)
    assert instance_scores(predicted, TRUTH).ap50 == pytest.approx(1 / 6)


def test_nothing_predicted_scores_nothing():
    scores = instance_scores(np.zeros_like(TRUTH), TRUTH)
    assert (scores.pq, scores.ap25, scores.predicted, scores.true) == (0.0, 0.0, 0, 3)
