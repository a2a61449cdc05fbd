"""Plane sweep from coarse to fine."""

from __future__ import annotations

import numpy as np
import pytest
from swept_box import CAMERA, FRAMES, IMAGES, T_from_to, relative_error, use_kernels

from toolkit.base.native import available_instruction_sets
from toolkit.depth.depth_priors.coarse_to_fine import Source, image_pair, sweep_depth

PAIRS = [image_pair(image) for image in IMAGES]
RANGE = (0.2, 1.0)


def sources(number: int, *others: int) -> list[Source]:
    return [Source(PAIRS[n], T_from_to(number, n)) for n in others]


@pytest.mark.parametrize("name", [None, *available_instruction_sets()])
def test_depth_is_accurate(name, monkeypatch):
    use_kernels(monkeypatch, name)
    found = sweep_depth(CAMERA, PAIRS[2], sources(2, 0, 4), RANGE)
    error = relative_error(found.inverse_depth, 2)
    # Borders of the boxes may look like what is behind them.
    assert (found.inverse_depth > 0).mean() > 0.8
    assert np.median(error) < 0.01
    assert (error > 0.2).mean() < 0.05


def test_instruction_sets_agree(monkeypatch):
    results = []
    for name in available_instruction_sets():
        use_kernels(monkeypatch, name)
        results.append(sweep_depth(CAMERA, PAIRS[1], sources(1, 0, 3), RANGE))
    for other in results[1:]:
        same = np.isclose(other.inverse_depth, results[0].inverse_depth, rtol=0.01)
        assert same.mean() > 0.98


def test_surfaces_nearer_than_the_range_have_no_depth():
    found = sweep_depth(CAMERA, PAIRS[2], sources(2, 0, 4), (0.05, 0.25))
    nearer = FRAMES[2].depth_m < 2.0
    assert (found.inverse_depth[nearer] == 0).mean() > 0.5


def test_images_of_odd_size_have_a_half():
    camera = CAMERA.cropped(0, 0, 101, 75)
    pairs = [image_pair(np.ascontiguousarray(image[:75, :101])) for image in IMAGES]
    assert pairs[0].half.shape == (37, 50)
    np.testing.assert_allclose(pairs[0].half[3, 5], pairs[0].full[6:8, 10:12].mean(), rtol=1e-5)
    others = [Source(pairs[n], T_from_to(2, n)) for n in (0, 4)]
    found = sweep_depth(camera, pairs[2], others, RANGE)
    true = FRAMES[2].depth_m[:75, :101]
    known = found.inverse_depth > 0
    error = np.abs(1.0 / found.inverse_depth[known] / true[known] - 1.0)
    assert known.mean() > 0.8
    assert np.median(error) < 0.01
