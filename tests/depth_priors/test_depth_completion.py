"""Completion of keyframes' depth with priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving_camera import film, walk

from toolkit.depth.depth_priors.completion import DepthCompletion, splatted
from toolkit.depth.depth_priors.multi_view import SweptKeyframe
from toolkit.depth.depth_priors.options import DepthPriorOptions, ScaleCorrectionOptions
from toolkit.depth.depth_priors.provider import DepthKind, PriorImage

POSES = walk(5)
FRAMES = film(POSES)
CAMERA = FRAMES[0].camera
SHAPE = (CAMERA.height, CAMERA.width)
VIEWS = [SweptKeyframe(n, T, 1.2, 4.0) for n, T in enumerate(POSES)]
# Known: a band on the left of the image.
KNOWN = np.broadcast_to(np.arange(SHAPE[1]) < 60, SHAPE)


def known_depth(number: int) -> np.ndarray:
    return np.where(KNOWN, FRAMES[number].depth_m, 0.0).astype(np.float32)


def exact_prior(number: int) -> PriorImage:
    values = 0.4 / FRAMES[number].depth_m + 0.1
    return PriorImage(values.astype(np.float32), np.ones(SHAPE, bool), DepthKind.AFFINE_INVERSE)


def completion(prior=exact_prior, depth=known_depth, **options) -> DepthCompletion:
    return DepthCompletion(CAMERA, VIEWS, depth, prior, DepthPriorOptions(**options))


def relative_error(depth: np.ndarray, number: int, mask: np.ndarray) -> float:
    return float(np.median(np.abs(depth / FRAMES[number].depth_m - 1.0)[mask]))


def test_known_depth_stays_and_the_rest_is_inferred():
    completed = completion().depth(2)
    assert np.array_equal(completed.depth[KNOWN], FRAMES[2].depth_m[KNOWN])
    assert np.array_equal(completed.inferred, ~KNOWN & (completed.depth > 0))
    assert completed.inferred.mean() > 0.5
    assert relative_error(completed.depth, 2, completed.inferred) < 0.02


def test_a_keyframe_without_own_depth_uses_that_of_its_neighbours():
    def others(number: int) -> np.ndarray:
        return np.zeros(SHAPE, np.float32) if number == 2 else known_depth(number)

    completed = completion(depth=others).depth(2)
    assert completed.inferred.mean() > 0.9
    assert relative_error(completed.depth, 2, completed.inferred) < 0.02


def test_a_prior_that_disagrees_with_known_depth_is_not_used():
    def unrelated(number: int) -> PriorImage:
        values = np.random.default_rng(number).uniform(0.1, 1.0, SHAPE).astype(np.float32)
        return PriorImage(values, np.ones(SHAPE, bool), DepthKind.AFFINE_INVERSE)

    completed = completion(unrelated).depth(2)
    assert not completed.inferred.any()
    assert np.array_equal(completed.depth, known_depth(2))


def test_without_known_depth_nothing_is_inferred():
    completed = completion(depth=lambda _: np.zeros(SHAPE, np.float32)).depth(2)
    assert not completed.depth.any()


def test_depth_far_outside_the_known_range_is_not_inferred():
    def with_sky(number: int) -> PriorImage:
        prior = exact_prior(number)
        values = prior.values.copy()
        values[:10] = 0.1001
        return replace(prior, values=values)

    assert not completion(with_sky).depth(2).inferred[:10].any()


@pytest.mark.parametrize("grid", [1, 3])
def test_the_grid_follows_a_prior_that_bends(grid):
    bend = np.linspace(0.85, 1.15, SHAPE[1], dtype=np.float32)
    known = np.broadcast_to(np.arange(SHAPE[1]) % 2 == 0, SHAPE)

    def bent(number: int) -> PriorImage:
        values = FRAMES[number].depth_m * bend
        return PriorImage(values, np.ones(SHAPE, bool), DepthKind.SCALED)

    completed = completion(
        bent,
        lambda n: np.where(known, FRAMES[n].depth_m, 0.0).astype(np.float32),
        correction=ScaleCorrectionOptions(grid=grid),
    ).depth(2)
    assert completed.inferred.mean() > 0.4
    error = relative_error(completed.depth, 2, completed.inferred)
    assert error < 0.03 if grid > 1 else error > 0.05


def test_the_nearest_point_counts():
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 1.0], [100.0, 0.0, 1.0]])
    depth = splatted(points, CAMERA)
    assert (depth > 0).sum() == 1
    assert depth.max() == 1.0
