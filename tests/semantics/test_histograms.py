"""Class histograms and their smoothed divergence."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.semantics import histograms as module
from toolkit.semantics.histograms import (
    SMOOTHING,
    class_counts,
    class_histogram,
    smoothed_kl,
)
from toolkit.semantics.taxonomy import Taxonomy


def histograms(classes: int):
    return st.lists(st.floats(0, 1e6), min_size=classes, max_size=classes).map(np.array)


pairs = st.integers(1, 12).flatmap(lambda n: st.tuples(histograms(n), histograms(n)))


def test_shares_are_of_the_labelled_pixels_alone():
    labels = np.array([[0, 0, 1, 3], [3, 3, 0, 0]])
    np.testing.assert_allclose(class_histogram(labels, 4), [0.25, 0, 0.75, 0])
    assert class_histogram(labels, Taxonomy.flat(["a", "b", "c", "d"])).sum() == pytest.approx(1)


def test_a_picture_of_void_has_no_shares():
    np.testing.assert_array_equal(class_histogram(np.zeros((3, 4), np.int32), 2), [0, 0])


@pytest.mark.parametrize("wrong", [-1, 3])
def test_an_id_outside_the_classes_is_refused(wrong):
    with pytest.raises(ValueError, match=r"0\.\.2"):
        class_histogram(np.array([1, wrong]), 2)


@given(pairs)
def test_the_divergence_is_finite_and_never_negative(pair):
    first, second = pair
    assert 0 <= smoothed_kl(first, second) <= math.log(1 + 1 / SMOOTHING) + 1e-9
    assert smoothed_kl(first, first) == 0


@given(pairs, st.floats(1e-3, 1e3))
def test_only_shares_count_not_sizes(pair, factor):
    first, second = pair
    scaled = smoothed_kl(first * factor, second)
    assert scaled == pytest.approx(smoothed_kl(first, second), rel=1e-6, abs=1e-9)


def test_it_is_the_textbook_value_up_to_smoothing(monkeypatch):
    p, q = np.array([0.5, 0.5]), np.array([0.9, 0.1])
    exact = 0.5 * math.log(0.5 / 0.9) + 0.5 * math.log(0.5 / 0.1)
    monkeypatch.setattr(module, "SMOOTHING", 1e-9)
    assert smoothed_kl(p, q) == pytest.approx(exact, rel=1e-6)
    # By hand, with 0.1 added to each class: (0.6, 0.6) / 1.2 against (1.0, 0.2) / 1.2.
    by_hand = 0.5 * math.log(0.6 / 1.0) + 0.5 * math.log(0.6 / 0.2)
    monkeypatch.setattr(module, "SMOOTHING", 0.1)
    assert smoothed_kl(p, q) == pytest.approx(by_hand)


def test_it_is_not_symmetric_and_grows_with_what_is_disjoint():
    p, q = np.array([1.0, 0.0, 0.0]), np.array([0.5, 0.5, 0.0])
    assert smoothed_kl(p, q) != pytest.approx(smoothed_kl(q, p), rel=0.1)
    disjoint = np.array([0.0, 0.0, 1.0])
    assert smoothed_kl(p, disjoint) > smoothed_kl(p, q)
    assert math.isfinite(smoothed_kl(p, disjoint))


def test_all_void_counts_as_knowing_nothing():
    uniform = np.full(4, 0.25)
    assert smoothed_kl(np.zeros(4), uniform) == pytest.approx(0)


def test_classes_are_counted_with_void_first():
    assert class_counts(np.array([[0, 1], [3, 3]]), 4).tolist() == [1, 1, 0, 2, 0]
    assert class_counts(np.zeros(0, int), 4).tolist() == [0] * 5
    with pytest.raises(ValueError, match=r"0\.\.2"):
        class_counts(np.array([3]), 2)
