"""Single pixels without depth inside of surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.slam.tracking import depth_filter
from toolkit.slam.tracking.depth_filter import denoised, without_gaps


def slanted() -> np.ndarray:
    """Inverse depth of a floor."""
    rows, columns = np.mgrid[:40, :60]
    return (0.3 + 0.004 * rows + 0.001 * columns).astype(np.float32)


def test_curves_of_missing_pixels_are_closed_on_a_slanted_surface():
    inverse = slanted()
    broken = inverse.copy()
    broken[10, :] = 0.0
    broken[np.arange(40), np.arange(40)] = 0.0
    closed = without_gaps(broken)
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(closed[inner], inverse[inner], rtol=2e-3)


def test_holes_and_depth_edges_stay_open():
    inverse = slanted()
    inverse[:, 30:] *= 2.0
    inverse[5:9, 5:9] = 0.0
    inverse[:, 30] = 0.0
    closed = without_gaps(inverse)
    assert not closed[6:8, 6:8].any() and not closed[:, 30].any()
    known = inverse > 0
    np.testing.assert_array_equal(closed[known], inverse[known])


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_depth_without_noise_is_not_changed(noise: float):
    inverse = slanted() + noise * np.random.default_rng(0).standard_normal((40, 60))
    depth_m = (1.0 / inverse).astype(np.float32)
    depth_m[10, :] = 0.0
    assert (denoised(depth_m)[10, 1:-1] > 0).all() == (noise > 0)


@pytest.mark.parametrize("name", available_instruction_sets())
def test_the_kernels_fill_the_same_gaps(name: str, monkeypatch: pytest.MonkeyPatch):
    inverse = slanted()
    inverse[:, 30:] *= 2.0
    inverse[np.random.default_rng(0).random(inverse.shape) < 0.3] = 0.0
    filled = []
    for variant in (None, load_variant(name)):
        monkeypatch.setattr(depth_filter, "kernels", lambda variant=variant: variant)
        filled.append(without_gaps(inverse))
    assert 0.5 < (filled[0] > 0)[inverse == 0].mean() < 1.0
    np.testing.assert_allclose(*filled, rtol=1e-6)
