"""Depth that reaches beyond the borders of near surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from swept_box import use_kernels

from toolkit.base.native import available_instruction_sets
from toolkit.depth.depth_priors.coarse_to_fine import remove_fattening

EVERY = pytest.mark.parametrize("name", [None, *available_instruction_sets()])
ROWS, COLUMNS = np.mgrid[:60, :80]


def disc(radius: float) -> np.ndarray:
    return np.hypot(ROWS - 30, COLUMNS - 40) < radius


def scene(near: float, far: float, noise: float = 0.02) -> np.ndarray:
    """Intensity [60, 80] of a disc in front of a background."""
    rng = np.random.default_rng(0)
    intensity = np.where(disc(15), near, far) + noise * rng.standard_normal((60, 80))
    return intensity.clip(0, 1).astype(np.float32)


def matched(radius: float) -> np.ndarray:
    """Inverse depth of a disc of some radius."""
    return np.where(disc(radius), 1.0, 0.5).astype(np.float32)


@EVERY
def test_a_wide_border_of_a_disc_is_removed(name, monkeypatch):
    use_kernels(monkeypatch, name)
    kept = remove_fattening(scene(0.7, 0.2), matched(20))
    assert (kept[disc(14)] == 1.0).all() and (kept[~disc(21)] == 0.5).all()
    assert (kept[disc(20) & ~disc(15)] == 0).all()


@EVERY
def test_a_right_border_stays(name, monkeypatch):
    use_kernels(monkeypatch, name)
    kept = remove_fattening(scene(0.7, 0.2), matched(15))
    assert (kept == matched(15)).all()


@EVERY
def test_surfaces_that_look_alike_stay(name, monkeypatch):
    use_kernels(monkeypatch, name)
    kept = remove_fattening(scene(0.4, 0.4), matched(20))
    assert (kept == matched(20)).mean() > 0.99


@EVERY
def test_a_slanted_plane_has_no_border(name, monkeypatch):
    use_kernels(monkeypatch, name)
    plane = (0.5 + 0.002 * COLUMNS).astype(np.float32)
    assert (remove_fattening(scene(0.7, 0.2), plane) == plane).all()


@EVERY
def test_unknown_depth_stays_unknown(name, monkeypatch):
    use_kernels(monkeypatch, name)
    nothing = np.zeros((60, 80), np.float32)
    assert (remove_fattening(scene(0.7, 0.2), nothing) == 0).all()


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("size", [(60, 80), (31, 17), (5, 3)])
def test_kernels_agree_with_the_reference(name, size, monkeypatch):
    """Also where windows and vectors are wider than the image."""
    rng = np.random.default_rng(1)
    intensity = rng.random(size, np.float32)
    inverse_depth = rng.choice(np.float32([0.0, 0.5, 0.51, 1.0]), size, p=[0.1, 0.4, 0.1, 0.4])
    # Surfaces, not single pixels.
    inverse_depth = np.where(ROWS < 20, inverse_depth[0, 0] + 0.3, matched(20))[
        : size[0], : size[1]
    ]
    inverse_depth = np.ascontiguousarray(inverse_depth, np.float32)
    results = []
    for kernels in (None, name):
        use_kernels(monkeypatch, kernels)
        results.append(remove_fattening(intensity, inverse_depth))
    assert (results[0] == results[1]).mean() > 0.999
