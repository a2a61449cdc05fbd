"""Comparison of the depths of several images."""

from __future__ import annotations

import numpy as np
import pytest
from swept_box import CAMERA, TRUE, posed, use_kernels

from toolkit.base.geometry import se3
from toolkit.base.native import available_instruction_sets
from toolkit.depth.depth_priors.consensus import AgreementOptions, find_consensus, relative_sigma
from toolkit.depth.depth_priors.problem import Consensus, NeighbourView

ALL = [None, *available_instruction_sets()]


def noisy(sigma: float) -> list[np.ndarray]:
    rng = np.random.default_rng(4)
    return [(q * (1 + sigma * rng.normal(size=q.shape))).astype(np.float32) for q in TRUE]


@pytest.mark.parametrize("name", available_instruction_sets())
def test_kernels_agree_with_the_reference(name, monkeypatch):
    images = noisy(0.01)
    for image in images:
        image[10:30, 20:50] = 0.0
    results = []
    for kernels in (None, name):
        use_kernels(monkeypatch, kernels)
        results.append(find_consensus(CAMERA, images[2], posed(images, 2, 0, 1, 3, 4)))
    expected, found = results
    np.testing.assert_allclose(found.parallax_px, expected.parallax_px, rtol=1e-3, atol=1e-4)
    same = (found.agreeing == expected.agreeing) & (found.conflicting == expected.conflicting)
    assert same.mean() > 0.999  # rounding decides at the tolerance
    for image in ("inverse_depth", "spread"):
        a, b = (getattr(result, image)[same] for result in (found, expected))
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ALL)
def test_true_depth_agrees_and_stays(name, monkeypatch):
    use_kernels(monkeypatch, name)
    found = find_consensus(CAMERA, TRUE[2], posed(TRUE, 2, 1, 3))
    assert (found.agreeing == 2).mean() > 0.8
    assert found.conflicting.mean() < 0.01
    both = found.agreeing == 2
    assert np.abs(found.inverse_depth[both] / TRUE[2][both] - 1).mean() < 1e-3


def test_fusion_reduces_noise():
    images = noisy(0.006)
    found = find_consensus(CAMERA, images[2], posed(images, 2, 0, 1, 3, 4))
    several = found.agreeing >= 3
    own = np.std(images[2][several] / TRUE[2][several] - 1)
    fused = np.std(found.inverse_depth[several] / TRUE[2][several] - 1)
    assert fused < 0.65 * own
    # The others are interpolated between pixels, which reduces their noise.
    assert 0.5 * 0.006 < found.spread[several].mean() < 0.006


def test_a_point_in_front_of_what_others_see_conflicts():
    nearer = TRUE[2].copy()
    nearer[40:60, 60:90] *= 1.5
    found = find_consensus(CAMERA, nearer, posed(TRUE, 2, 1, 3))
    assert (found.conflicting[42:58, 62:88] == 2).mean() > 0.9
    assert found.agreeing[42:58, 62:88].max() == 0


def test_a_point_behind_what_others_see_is_only_hidden():
    farther = (TRUE[2] / 1.5).astype(np.float32)
    found = find_consensus(CAMERA, farther, posed(TRUE, 2, 1, 3))
    assert found.conflicting.mean() < 0.01
    assert found.agreeing.mean() < 0.01


def test_parallax_is_the_motion_of_a_pixel():
    """A camera that moved 0.1 to the side sees points of depth 2 move by f 0.1 / 2."""
    depth = np.full_like(TRUE[0], 0.5)
    moved = NeighbourView(depth, se3.exp([-0.1, 0, 0, 0, 0, 0]))
    found = find_consensus(CAMERA, depth, [moved])
    seen = found.agreeing > 0
    assert seen.mean() > 0.8
    np.testing.assert_allclose(found.parallax_px[seen], CAMERA.fx * 0.1 / 2.0, rtol=1e-4)


def test_unknown_depth_stays_unknown():
    empty = np.zeros_like(TRUE[0])
    found = find_consensus(CAMERA, empty, posed(TRUE, 0, 1))
    assert not found.inverse_depth.any()
    assert not found.agreeing.any()
    found = find_consensus(CAMERA, TRUE[0], [NeighbourView(empty, np.eye(4))])
    np.testing.assert_array_equal(found.inverse_depth, TRUE[0])
    assert not found.agreeing.any()


def test_tolerance_decides():
    wrong = [NeighbourView(np.asarray(1.05 * TRUE[2], np.float32), np.eye(4))]
    assert not find_consensus(CAMERA, TRUE[2], wrong).agreeing.any()
    loose = find_consensus(CAMERA, TRUE[2], wrong, AgreementOptions(tolerance=0.1))
    assert (loose.agreeing > 0).mean() > 0.9


def test_sigma_grows_with_spread_and_falls_with_parallax_and_agreement():
    def sigma(spread=0.005, parallax=50.0, agreeing=3.0, margin=0.05):
        images = [np.array([[v]], np.float32) for v in (0.5, spread, parallax, agreeing, 0.0)]
        return relative_sigma(Consensus(*images), np.array([[margin]], np.float32)).item()

    assert sigma(spread=0.01) > 1.3 * sigma()
    assert sigma(parallax=5.0) > 2.0 * sigma()
    assert sigma(agreeing=6.0) < 0.7 * sigma()
    assert sigma(margin=0.2) < 0.8 * sigma()
    assert sigma(agreeing=0.0) == np.inf
    assert np.isfinite(sigma(parallax=0.0, margin=0.0))


def test_sizes_must_agree():
    with pytest.raises(ValueError, match="float32 of shape"):
        find_consensus(CAMERA, TRUE[0][1:], [])
