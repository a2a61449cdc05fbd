"""Scale and shift of depth priors with noise and outliers, for whole images and on a grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.depth.depth_priors.alignment import (
    Samples,
    ScaleShift,
    fit,
    fit_grid,
    least_squares,
    robust_fit,
    samples_of,
)
from toolkit.depth.depth_priors.provider import DepthKind, PriorImage

SHAPE = (120, 160)


def true_depth() -> np.ndarray:
    """A floor and a box in front of a wall."""
    rows = np.linspace(0.0, 1.0, SHAPE[0])[:, None]
    depth = np.broadcast_to(np.minimum(4.5, 1.2 / np.maximum(rows - 0.15, 1e-3)), SHAPE).copy()
    depth[40:80, 50:90] = 1.6
    return depth.astype(np.float32)


def degraded(
    depth_m: np.ndarray, scale: float, shift: float, kind: DepthKind, seed: int = 0
) -> PriorImage:
    """A prior that scale and shift correct, with 20 % noise and 30 % outliers."""
    rng = np.random.default_rng(seed)
    x = 1.0 / depth_m if kind.inverse else depth_m
    values = (x - shift) / scale * (1.0 + 0.2 * rng.standard_normal(SHAPE))
    wrong = rng.uniform(0.0, 3.0, SHAPE) * np.median(values)
    values = np.where(rng.random(SHAPE) < 0.3, wrong, values).astype(np.float32)
    return PriorImage(values, np.ones(SHAPE, bool), kind)


def pooled(kind: DepthKind, scale: float, shift: float) -> Samples:
    """A set of eight images."""
    depth = true_depth()
    priors = [degraded(depth, scale, shift, kind, seed) for seed in range(8)]
    return Samples.joined([samples_of(prior, depth) for prior in priors])


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (0.4, 0.5), (2.7, -0.3)])
def test_scale_and_shift_of_depth_are_found_within_one_percent(scale, shift):
    found = robust_fit(pooled(DepthKind.AFFINE, scale, shift))
    assert found.scale == pytest.approx(scale, rel=0.01)
    assert found.shift == pytest.approx(shift, abs=0.01 * float(np.median(true_depth())))
    assert found.noise == pytest.approx(0.2, abs=0.06)
    assert 0.65 < found.inliers < 0.9


@pytest.mark.parametrize(("scale", "shift"), [(0.02, 0.05), (3.0, -0.1)])
def test_scale_and_shift_of_inverse_depth_are_found(scale, shift):
    found = robust_fit(pooled(DepthKind.AFFINE_INVERSE, scale, shift))
    assert found.scale == pytest.approx(scale, rel=0.015)
    assert found.shift == pytest.approx(shift, abs=0.015 / float(np.median(true_depth())))


def test_plain_least_squares_is_far_off():
    """Noise in the values attenuates the scale, and outliers even more."""
    found = least_squares(pooled(DepthKind.AFFINE, 2.0, 0.3))
    assert found.scale < 1.6


@given(scale=st.floats(0.1, 10.0), shift=st.floats(-0.5, 0.5))
def test_exact_priors_are_corrected_exactly(scale, shift):
    depth = true_depth()
    prior = PriorImage(((depth - shift) / scale), np.ones(SHAPE, bool), DepthKind.AFFINE)
    for estimate in (robust_fit, least_squares):
        found = estimate(samples_of(prior, depth))
        assert found.scale == pytest.approx(scale, rel=1e-3)
        assert np.allclose(found.apply(prior), depth, rtol=1e-3)


def test_a_prior_without_shift_gets_none():
    samples = pooled(DepthKind.SCALED, 0.5, 0.0)
    assert fit(samples, DepthKind.SCALED, robust=True).shift == 0.0
    assert fit(samples, DepthKind.AFFINE, robust=True).shift != 0.0


def test_a_wall_in_parallel_to_the_image_has_no_shift():
    depth = np.full(SHAPE, 2.0, np.float32)
    prior = degraded(depth, 0.5, 0.0, DepthKind.AFFINE)
    found = robust_fit(samples_of(prior, depth))
    assert (found.scale, found.shift) == (pytest.approx(0.5, rel=0.01), 0.0)


@pytest.mark.parametrize("estimate", [robust_fit, least_squares])
def test_there_is_no_correction_of_too_few_or_reversed_values(estimate):
    depth = true_depth()
    prior = PriorImage(-depth, np.ones(SHAPE, bool), DepthKind.AFFINE)
    assert estimate(samples_of(prior, depth)) is None
    nothing = PriorImage(depth, np.zeros(SHAPE, bool), DepthKind.AFFINE)
    assert estimate(samples_of(nothing, depth)) is None


def test_confident_pixels_count_more():
    depth = true_depth()
    values = depth.copy()
    values[:, :100] *= 3.0
    weights = np.where(np.arange(SHAPE[1]) < 100, 0.01, 1.0).astype(np.float32)
    weights = np.broadcast_to(weights, SHAPE)
    prior = PriorImage(values, np.ones(SHAPE, bool), DepthKind.SCALED, weights)
    start = samples_of(prior, depth)
    assert least_squares(start, with_shift=False).scale < 0.6
    grid = fit_grid(start, ScaleShift(1.0, 0.0, 0.1), 2, with_shift=False)
    assert grid.whole.scale == 1.0
    assert np.median(grid.apply(prior)[:, 140:] / depth[:, 140:]) == pytest.approx(1.0, abs=0.02)


def bent(depth_m: np.ndarray) -> PriorImage:
    """A prior whose scale changes by 40 % from left to right."""
    prior = degraded(depth_m, 1.0, 0.0, DepthKind.SCALED)
    slope = np.linspace(0.8, 1.2, SHAPE[1], dtype=np.float32)
    return PriorImage(prior.values * slope, prior.known, prior.kind)


def median_error(corrected: np.ndarray, prior: PriorImage, depth_m: np.ndarray) -> float:
    """Median over columns of the error of a column's median."""
    columns = np.median(corrected / depth_m, axis=0)
    return float(np.median(np.abs(columns - 1.0)))


def test_a_grid_halves_the_error_of_a_prior_that_bends():
    depth = true_depth()
    prior = bent(depth)
    samples = samples_of(prior, depth)
    whole = robust_fit(samples, with_shift=False)
    grid = fit_grid(samples, whole, 3, with_shift=False)
    one, local = (median_error(c.apply(prior), prior, depth) for c in (whole, grid))
    assert local < 0.5 * one


def test_nodes_without_reference_follow_their_neighbours():
    depth = true_depth()
    prior = bent(depth)
    seen = depth.copy()
    seen[:, 80:] = 0.0
    samples = samples_of(prior, seen)
    whole = robust_fit(samples, with_shift=False)
    grid = fit_grid(samples, whole, 4, with_shift=False)
    assert np.ptp(grid.slope) < 0.5
    assert (grid.slope > 0).all()
    assert (grid.apply(prior) > 0).all()
