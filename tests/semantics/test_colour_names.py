"""Colours of things in rooms have the names that people use."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.semantics.colour_names import colour_name


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((10, 10, 10), "black"),
        ((120, 122, 119), "grey"),
        ((250, 250, 246), "white"),
        ((190, 20, 25), "red"),
        ((240, 130, 20), "orange"),
        ((250, 220, 40), "yellow"),
        ((40, 130, 50), "green"),
        ((30, 60, 170), "blue"),
        ((120, 60, 150), "purple"),
        ((240, 150, 180), "pink"),
        ((100, 65, 40), "brown"),
    ],
)
def test_typical_colours(rgb, name):
    assert colour_name(np.array([rgb]) / 255.0, np.ones(1)) == name


def test_the_largest_area_counts():
    rgb = np.array([(190, 20, 25)] * 3 + [(30, 60, 170)]) / 255.0
    assert colour_name(rgb, np.ones(4)) == "red"
    assert colour_name(rgb, np.array([1.0, 1.0, 1.0, 9.0])) == "blue"
