"""Allocation of seed pixels to classes (G-III.A)."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from toolkit.splatting.gaussians.allocation import (
    choose_pixels,
    pixels_per_class,
    printed_pixels_per_class,
)

AREAS = st.lists(st.integers(0, 5000), min_size=1, max_size=30)


@given(AREAS, st.integers(0, 60000))
def test_total_is_reached_and_no_class_exceeds_its_area(areas, total):
    counts = pixels_per_class(np.array(areas), total)
    assert (counts >= 0).all() and (counts <= areas).all()
    assert counts.sum() == min(total, sum(areas))


@given(AREAS, st.integers(0, 60000))
def test_unlimited_classes_are_proportional_to_the_square_root(areas, total):
    areas = np.array(areas)
    counts = pixels_per_class(areas, total)
    open_classes = counts < areas
    if open_classes.sum() > 1:
        ratio = counts[open_classes] / np.sqrt(areas[open_classes])
        spread = 1.0 / np.sqrt(areas[open_classes].min())  # one pixel of rounding
        assert ratio.max() - ratio.min() <= 2 * spread


def test_small_class_is_limited_and_the_remainder_redistributed():
    assert pixels_per_class(np.array([50, 10000, 40000]), 10050).tolist() == [50, 3333, 6667]


def test_printed_distribution_leaves_the_remainder():
    """100, 10000 and 40000 have roots 10, 100, 200: of 50100, 1616, 16161 and 32322 are asked."""
    counts = printed_pixels_per_class(np.array([100, 10000, 40000]), 50100)
    assert counts.tolist() == [100, 10000, 32322]
    assert printed_pixels_per_class(np.zeros(2, int), 10).tolist() == [0, 0]


def test_areas_of_the_chosen_pixels_add_up_to_the_mask():
    generator = np.random.default_rng(0)
    mask = generator.random((40, 50)) < 0.7
    ids = generator.integers(0, 4, mask.shape)
    chosen, area = choose_pixels(mask, ids, 0.3, generator)
    assert not (chosen & ~mask).any()
    assert chosen.sum() == np.ceil(0.3 * mask.sum())
    for k in range(4):
        assert np.isclose(area[chosen & (ids == k)].sum(), (mask & (ids == k)).sum(), rtol=1e-5)


def test_empty_mask_chooses_no_pixels():
    chosen, area = choose_pixels(np.zeros((3, 4), bool), None, 0.5, np.random.default_rng(0))
    assert not chosen.any() and (area == 1).all()
