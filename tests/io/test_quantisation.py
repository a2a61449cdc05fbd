"""Codebooks, palettes, orders and quaternions of compressed files."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.io.morton import morton_order
from toolkit.io.quantisation import codebook, nearest_codes, palette
from toolkit.io.smallest_three import join_largest, split_largest


def test_a_codebook_is_better_than_even_steps_and_covers_outliers():
    rng = np.random.default_rng(0)
    values = np.append(rng.normal(0, 1, 5000), [-40.0, 40.0])
    codes = codebook(values)
    errors = np.abs(values - codes[nearest_codes(values, codes)])
    even = 80.0 / 255 / np.sqrt(12)
    assert np.sqrt((errors**2).mean()) < even / 5
    assert errors.max() < 0.5


def test_few_values_are_exact():
    values = np.repeat([-1.0, 0.25, 7.0], 4)
    codes = codebook(values)
    assert len(codes) == 256
    np.testing.assert_allclose(codes[nearest_codes(values, codes)], values, atol=1e-12)
    assert set(codebook(np.full(9, 3.5))) == {3.5}


def test_a_palette_as_large_as_the_data_is_exact():
    vectors = np.random.default_rng(0).normal(size=(600, 9)).astype(np.float32)
    entries, index = palette(vectors, 1024)
    np.testing.assert_allclose(entries[index], vectors, atol=1e-6)


def test_a_palette_finds_clusters_and_is_reproducible():
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(300, 6))
    owner = rng.integers(0, 300, 4000)
    vectors = (centres[owner] + rng.normal(0, 0.01, (4000, 6))).astype(np.float32)
    entries, index = palette(vectors, 1024)
    assert 300 <= len(entries) <= 1024
    assert np.sqrt(((entries[index] - vectors) ** 2).mean()) < 0.02
    again, same = palette(vectors, 1024)
    assert again.tobytes() == entries.tobytes()
    np.testing.assert_array_equal(same, index)


def test_equal_vectors_need_one_entry():
    vectors = np.ones((5000, 3), np.float32)
    entries, index = palette(vectors, 1024)
    np.testing.assert_array_equal(entries[index], vectors)


def test_neighbours_are_close_in_morton_order():
    points = np.random.default_rng(0).uniform(0, 1, (4000, 3))
    points[7] = 1e6
    order = morton_order(points)
    assert sorted(order) == list(range(4000))
    steps = np.linalg.norm(np.diff(points[order[order != 7]], axis=0), axis=1)
    assert np.median(steps) < 0.1
    assert morton_order(np.ones((3, 3))).tolist() == [0, 1, 2]


@pytest.mark.parametrize("largest", range(4))
def test_quaternions_are_restored(largest):
    rng = np.random.default_rng(largest)
    q = rng.normal(size=(50, 4))
    q[:, largest] *= 10
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    index, others = split_largest(q)
    assert np.abs(others).max() <= 0.5**0.5
    turns = np.abs((join_largest(index, others) * q).sum(axis=1))
    np.testing.assert_allclose(turns, 1.0, atol=1e-12)
