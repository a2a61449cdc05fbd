"""Descriptor search: exact distances, and identical results after a restore."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.base.errors import DependencyError
from toolkit.slam.loops import retrieval
from toolkit.slam.loops.retrieval import DescriptorIndex

pytest.importorskip("faiss")
D = 16


def units(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, D)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def filled(vectors: np.ndarray) -> DescriptorIndex:
    index = DescriptorIndex(D)
    for vector in vectors:
        index.add(vector)
    return index


@given(count=st.integers(1, 60), wanted=st.integers(1, 20), seed=st.integers(0, 1000))
def test_distances_are_euclidean_and_cosines_dot_products(count, wanted, seed):
    vectors, query = units(count, seed), units(1, seed + 1)[0]
    found = filled(vectors).search(query, wanted)
    distances = np.linalg.norm(vectors - query, axis=1)
    order = np.argsort(distances, kind="stable")[:wanted]
    assert [n.keyframe for n in found] == order.tolist()
    np.testing.assert_allclose([n.distance for n in found], distances[order], atol=1e-5)
    np.testing.assert_allclose([n.cosine for n in found], vectors[order] @ query, atol=1e-5)


@given(seed=st.integers(0, 1000), keep=st.sets(st.integers(0, 29)))
def test_search_is_restricted_to_the_given_keyframes(seed, keep):
    vectors, query = units(30, seed), units(1, seed + 1)[0]
    found = filled(vectors).search(query, 5, among=keep)
    nearest = sorted(keep, key=lambda i: np.linalg.norm(vectors[i] - query))[:5]
    assert [n.keyframe for n in found] == nearest


def test_ties_return_the_older_keyframe_first():
    vectors = np.repeat(units(2, 0), 20, axis=0)
    found = filled(vectors).search(vectors[-1], 5)
    assert [n.keyframe for n in found] == [20, 21, 22, 23, 24]
    assert found[0].distance == pytest.approx(0.0, abs=1e-3)


def test_restored_index_returns_identical_results():
    vectors, more, queries = units(40, 1), units(10, 2), units(20, 3)
    index = filled(vectors)
    restored = DescriptorIndex.from_state(index.state(), D)
    for vector in more:
        assert index.add(vector) == restored.add(vector)
    for query in queries:
        assert index.search(query, 7) == restored.search(query, 7)
        assert index.search(query, 7, range(5, 30)) == restored.search(query, 7, range(5, 30))


def test_empty_index_returns_nothing_and_can_be_restored():
    index = DescriptorIndex.from_state(DescriptorIndex(D).state(), D)
    assert len(index) == 0
    assert index.search(units(1, 0)[0], 5) == []
    index.add(units(1, 0)[0])
    assert index.search(units(1, 0)[0], 5, among=[]) == []


def test_stored_descriptors_are_unchanged():
    vectors = units(5, 0)
    np.testing.assert_array_equal(filled(vectors).descriptor(3), vectors[3])


def test_invalid_descriptors_raise():
    index = DescriptorIndex(D)
    with pytest.raises(ValueError, match=r"shape \[16\]"):
        index.add(np.ones(D - 1, np.float32))
    for wrong in (2.0 * units(1, 0)[0], np.zeros(D, np.float32), np.full(D, np.nan, np.float32)):
        with pytest.raises(ValueError, match="unit norm"):
            index.add(wrong)
    index.add(units(1, 0)[0])
    with pytest.raises(ValueError, match=r"0\.\.0"):
        index.search(units(1, 0)[0], 1, among=[1])


def test_opposite_descriptors_have_distance_two():
    index = filled(units(1, 0))
    (found,) = index.search(-units(1, 0)[0], 1)
    assert found.distance == pytest.approx(2.0, abs=1e-5)
    assert found.cosine == pytest.approx(-1.0, abs=1e-5)
    assert math.isclose(found.cosine, 1.0 - found.distance**2 / 2.0, abs_tol=1e-6)


def test_missing_faiss_error_names_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "faiss", None)
    retrieval.faiss.cache_clear()
    try:
        with pytest.raises(DependencyError, match="pip install faiss-cpu"):
            DescriptorIndex(D)
    finally:
        retrieval.faiss.cache_clear()
