"""Landmark vectors: rare classes count, strays and absent ones do not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.loops.landmarks import gaussian_idf, keyframe_idf, landmark_distance, landmark_vectors
from toolkit.loops.options import LandmarkOptions

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


def test_what_every_keyframe_sees_weighs_nothing():
    np.testing.assert_allclose(
        keyframe_idf(COUNTS), [0, 0, math.log(5 / 3), math.log(5 / 3), math.log(5)]
    )


@pytest.mark.parametrize("options", ALL, ids=lambda o: o.weighting)
def test_views_of_one_place_agree_and_of_two_places_do_not(options):
    vectors = landmark_vectors(COUNTS, options)
    assert landmark_distance(vectors[0], vectors[1]) == pytest.approx(0.0, abs=1e-12)
    assert landmark_distance(vectors[0], vectors[2]) == pytest.approx(math.sqrt(2))


def test_a_vector_is_the_root_of_shares_times_rarity():
    counts = np.array([[40, 60, 0], [100, 0, 0], [0, 0, 100]])
    weights = np.sqrt([0.4, 0.6]) * np.log([4 / 3, 4 / 2])
    vector = landmark_vectors(counts)[0]
    np.testing.assert_allclose(vector, [*(weights / np.linalg.norm(weights)), 0.0])
    linear = landmark_vectors(counts, LandmarkOptions("linear"))[0]
    assert linear[1] / linear[0] == pytest.approx(1.5 * math.log(2) / math.log(4 / 3))


@given(st.integers(0, 10_000), st.sampled_from(["sqrt", "linear", "paper"]))
def test_vectors_are_finite_units_or_zero(seed, weighting):
    generator = np.random.default_rng(seed)
    counts = generator.integers(0, 200, (6, 5)) * generator.integers(0, 2, (6, 5))
    vectors = landmark_vectors(counts, LandmarkOptions(weighting), counts.sum(axis=0))
    lengths = np.linalg.norm(vectors, axis=1)
    assert np.isfinite(vectors).all()
    assert ((np.abs(lengths - 1) < 1e-9) | (lengths == 0)).all()
    assert not vectors[counts == 0].any()


def test_a_stray_gaussian_moves_only_the_papers_vector():
    two_strays = COUNTS.copy()
    two_strays[0, DESK], two_strays[1, DESK] = 1, 2
    vectors = landmark_vectors(two_strays)
    assert landmark_distance(vectors[0], vectors[1]) == pytest.approx(0.0, abs=1e-12)
    map_counts = COUNTS.sum(axis=0)
    printed = landmark_vectors(two_strays, LandmarkOptions("paper", min_count=1), map_counts)
    floored = landmark_vectors(two_strays, LandmarkOptions("paper", min_count=100), map_counts)
    assert printed[0, DESK] > 0.9  # of 1: one Gaussian of 8,901
    assert floored[0, DESK] < printed[0, DESK]


def test_the_papers_weighting_is_equation_7():
    counts, map_counts = np.array([[400, 100]]), np.array([5000, 500])
    expected = np.array([500 / 400, 500 / 100]) * np.log(5500 / np.array([5001, 501]))
    vector = landmark_vectors(counts, LandmarkOptions("paper", min_count=1), map_counts)[0]
    np.testing.assert_allclose(vector, expected / np.linalg.norm(expected))
    np.testing.assert_allclose(gaussian_idf(map_counts), np.log(5500 / np.array([5001, 501])))
    with pytest.raises(ValueError, match="map_counts"):
        landmark_vectors(counts, LandmarkOptions("paper"))


def test_without_anything_that_tells_the_distance_is_unknown():
    vectors = landmark_vectors(np.array([[500, 20], [400, 30]]))
    assert not vectors.any()
    assert landmark_distance(vectors[0], vectors[1]) is None
    assert landmark_vectors(np.zeros((3, 0), int)).shape == (3, 0)


def test_wrong_counts_are_refused():
    with pytest.raises(ValueError, match=r"\[K, C\]"):
        landmark_vectors(np.zeros(4, int))
    with pytest.raises(ValueError, match="not negative"):
        landmark_vectors(np.array([[-1, 3]]))
