"""Clusters of classes by shape, k by silhouette, balanced."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.semantics.taxonomy_building.clustering import (
    balanced,
    clusters_of,
    standardised,
    with_unmeasured,
)


def blobs(*centres_and_counts, spread=0.1, seed=0):
    """Named points around centres: a0, a1, ..., b0, ..."""
    rng = np.random.default_rng(seed)
    return {
        f"{letter}{i}": rng.normal(centre, spread)
        for letter, (centre, count) in zip("abcdef", centres_and_counts, strict=False)
        for i in range(count)
    }


def letters(clusters):
    return ["".join(sorted({name[0] for name in cluster})) for cluster in clusters]


def test_standardised_has_zero_mean_and_unit_variance():
    rng = np.random.default_rng(0)
    table = {f"c{i}": rng.normal([5, -3, 7], [2, 0.1, 0]) for i in range(50)}
    values = np.stack(list(standardised(table).values()))
    np.testing.assert_allclose(values.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(values.std(axis=0), [1, 1, 0], atol=1e-12)
    assert standardised({}) == {}


@pytest.mark.parametrize("k", [2, 3, 4])
def test_the_number_of_clusters_is_found(k):
    points = blobs(*[((4.0 * i, (-1.0) ** i * 3), 4) for i in range(k)])
    clusters = clusters_of(points, max_clusters=5, max_items=99)
    assert letters(clusters) == list("abcd"[:k])


def test_k_respects_what_a_cluster_should_hold():
    points = blobs(((0, 0), 6), ((9, 0), 6))
    assert len(clusters_of(points, max_clusters=6, max_items=12)) == 2
    assert len(clusters_of(points, max_clusters=6, max_items=4)) >= 3


def test_the_order_of_names_does_not_matter():
    points = blobs(((0, 0), 5), ((2, 1), 5), ((0, 3), 5), spread=0.8)
    turned = dict(reversed(points.items()))
    assert clusters_of(points, 4, 4) == clusters_of(turned, 4, 4)


def test_equal_shapes_are_one_cluster():
    assert clusters_of({"a": np.ones(2), "b": np.ones(2)}, 4, 4) == [["a", "b"]]


def test_items_between_two_clusters_move_for_balance_and_others_stay():
    table = np.array([[0.0], [0.1], [0.2], [0.3], [1.4], [3.0], [3.1]])
    labels = np.array([0, 0, 0, 0, 0, 1, 1])
    moved = balanced(table, labels, np.array([[0.2], [3.0]]), max_items=9)
    assert moved.tolist() == [0, 0, 0, 0, 1, 1, 1]  # 4 and 3; 1.4 lies nearly half-way
    apart = np.array([[0.0], [0.1], [0.2], [0.3], [0.1], [3.0], [3.1]])
    kept = balanced(apart, labels, np.array([[0.2], [3.0]]), max_items=9)
    assert kept.tolist() == labels.tolist()


def test_beyond_what_a_cluster_may_hold_items_move_however_far_they_are():
    table = np.array([[0.0], [0.1], [0.2], [0.3], [0.15], [3.0]])
    labels = np.array([0, 0, 0, 0, 0, 1])
    moved = balanced(table, labels, np.array([[0.15], [3.0]]), max_items=4)
    assert np.bincount(moved).max() <= 4
    assert moved[3] == 1  # the one that loses least


def test_strays_join_their_kin_or_the_smallest():
    clusters = [["a", "b"], ["c"]]
    grown = with_unmeasured(clusters, ["y", "z"], [["a", "z"], ["b", "c"], ["y"]])
    assert grown == [("a", "b", "z"), ("c", "y")]
