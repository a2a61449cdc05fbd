"""Connected regions of class images."""

from __future__ import annotations

import numpy as np

from toolkit.base.geometry.regions import connected_regions

CLASS_IDS = np.array(
    [
        [5, 5, 0, 2, 2],
        [0, 0, 5, 0, 2],
        [2, 0, 0, 0, 0],
        [0, 0, 0, -1, 5],
    ]
)


def test_regions_are_numbered_in_the_order_of_classes():
    regions, classes = connected_regions(CLASS_IDS)
    assert classes.tolist() == [2, 2, 5, 5]
    assert np.array_equal(np.append(0, classes)[regions], np.maximum(CLASS_IDS, 0))
    assert sorted(np.bincount(regions.ravel())[1:].tolist()) == [1, 1, 3, 3]


def test_diagonal_neighbours_are_apart_with_4_neighbours():
    regions, classes = connected_regions(CLASS_IDS, connectivity=4)
    assert classes.tolist() == [2, 2, 5, 5, 5]
    assert regions[0, 0] != regions[1, 2]


def test_small_regions_are_left_out():
    regions, classes = connected_regions(CLASS_IDS, min_pixels=2)
    assert classes.tolist() == [2, 5]
    assert regions[2, 0] == regions[3, 4] == 0


def test_an_image_without_classes_has_no_regions():
    regions, classes = connected_regions(np.zeros((3, 4), np.int32))
    assert not regions.any()
    assert len(classes) == 0
