"""Landmark vectors: weighting of rare, stray and absent classes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.slam.loops.landmarks import (
    keyframe_idf,
    landmark_distance,
    landmark_vectors,
    printed_vectors,
)
from toolkit.slam.loops.options import LandmarkOptions

# Wall and floor everywhere; a bed in one place, a desk in another.
WALL, FLOOR, BED, DESK, NOWHERE = range(5)
COUNTS = np.array(
    [
        [5000, 3000, 900, 0, 0],
        [6000, 2500, 400, 0, 0],
        [5500, 2000, 0, 800, 0],
        [4000, 3500, 0, 300, 0],
    ]
)
ALL = [LandmarkOptions(w) for w in ("sqrt", "linear")]


def test_classes_seen_by_all_keyframes_have_zero_weight():
    np.testing.assert_allclose(
        keyframe_idf(COUNTS), [0, 0, math.log(5 / 3), math.log(5 / 3), math.log(5)]
    )


@pytest.mark.parametrize("options", ALL, ids=lambda o: o.weighting)
def test_views_of_one_place_are_closer_than_views_of_two_places(options):
    vectors = landmark_vectors(COUNTS, options)
    assert landmark_distance(vectors[0], vectors[1]) == pytest.approx(0.0, abs=1e-12)
    assert landmark_distance(vectors[0], vectors[2]) == pytest.approx(math.sqrt(2))


def test_vector_is_square_root_of_share_times_idf():
    counts = np.array([[40, 60, 0], [100, 0, 0], [0, 0, 100]])
    weights = np.sqrt([0.4, 0.6]) * np.log([4 / 3, 4 / 2])
    vector = landmark_vectors(counts)[0]
    np.testing.assert_allclose(vector, [*(weights / np.linalg.norm(weights)), 0.0])
    linear = landmark_vectors(counts, LandmarkOptions("linear"))[0]
    assert linear[1] / linear[0] == pytest.approx(1.5 * math.log(2) / math.log(4 / 3))


@given(st.integers(0, 10_000), st.sampled_from(["sqrt", "linear", "inverse"]))
def test_vectors_are_finite_with_unit_or_zero_length(seed, weighting):
    generator = np.random.default_rng(seed)
    counts = generator.integers(0, 200, (6, 5)) * generator.integers(0, 2, (6, 5))
    vectors = landmark_vectors(counts, LandmarkOptions(weighting))
    lengths = np.linalg.norm(vectors, axis=1)
    assert np.isfinite(vectors).all()
    assert ((np.abs(lengths - 1) < 1e-9) | (lengths == 0)).all()
    assert not vectors[counts == 0].any()


def test_stray_gaussian_only_changes_inverse_weights():
    two_strays = COUNTS.copy()
    two_strays[0, DESK], two_strays[1, DESK] = 1, 2
    vectors = landmark_vectors(two_strays)
    assert landmark_distance(vectors[0], vectors[1]) == pytest.approx(0.0, abs=1e-12)
    unlimited = landmark_vectors(two_strays, LandmarkOptions("inverse", min_count=1))
    floored = landmark_vectors(two_strays, LandmarkOptions("inverse", min_count=100))
    assert unlimited[0, DESK] > 0.9  # of 1: one Gaussian of 8,901
    assert floored[0, DESK] < unlimited[0, DESK]


def test_printed_vectors_are_equation_7_of_each_submap():
    """Neither floored nor normalised: a second stray Gaussian halves the weight of its class."""
    counts = np.array([[400, 100, 0], [499, 1, 0], [498, 2, 0]])
    submaps = np.array([[5000, 500, 20], [3000, 10, 0], [3000, 10, 0]])
    vectors = printed_vectors(counts, submaps)
    np.testing.assert_allclose(
        vectors[0], [500 / 400 * math.log(5520 / 5001), 500 / 100 * math.log(5520 / 501), 0.0]
    )
    np.testing.assert_allclose(vectors[1, 1], 500 * math.log(3010 / 11))
    assert vectors[1, 1] == pytest.approx(2 * vectors[2, 1])


def test_distance_is_none_for_uninformative_views():
    vectors = landmark_vectors(np.array([[500, 20], [400, 30]]))
    assert not vectors.any()
    assert landmark_distance(vectors[0], vectors[1]) is None
    assert landmark_vectors(np.zeros((3, 0), int)).shape == (3, 0)
