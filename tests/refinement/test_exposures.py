"""Exposure compensation between overlapping submaps."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.exposure import IDENTITY, NEUTRAL, Exposure
from toolkit.slam.refinement.exposures import (
    at_typical_exposure,
    estimate_exposures,
    typical_exposure,
)


def submap(keys, truth, gain, bias=0.0, noise=0.0, seed=0):
    colours = (truth[keys] - bias) / gain
    return np.array(keys), colours + noise * np.random.default_rng(seed).normal(size=colours.shape)


def gain_and_bias(exposure: Exposure) -> tuple[float, float]:
    assert exposure.balance == NEUTRAL
    return exposure.gain, exposure.bias


@pytest.fixture
def truth():
    return np.random.default_rng(1).uniform(0.1, 0.9, (4000, 3))


@pytest.mark.parametrize("biases", [(0.0, 0.0), (-0.05, 0.1)])
def test_exposures_propagate_along_overlaps(truth, biases):
    submaps = {
        0: submap(range(1500), truth, 1.0),
        3: submap(range(1000, 2500), truth, 1.3, biases[0]),
        5: submap(range(2000, 4000), truth, 0.8, biases[1]),
    }
    found = estimate_exposures(submaps)
    assert found[0] == IDENTITY
    assert gain_and_bias(found[3]) == pytest.approx((1.3, biases[0]), abs=0.01)
    assert gain_and_bias(found[5]) == pytest.approx((0.8, biases[1]), abs=0.01)


def test_noise_does_not_reduce_contrast_over_many_submaps(truth):
    submaps = {
        n: submap(range(150 * n, 150 * n + 300), truth, 1.0, noise=0.03, seed=n) for n in range(20)
    }
    assert gain_and_bias(estimate_exposures(submaps)[19]) == pytest.approx((1.0, 0.0), abs=0.05)


def test_changed_voxels_are_outliers(truth):
    keys, colours = submap(range(1000), truth, 1.2, noise=0.01)
    colours[:200] = np.random.default_rng(2).uniform(0, 1, (200, 3))
    found = estimate_exposures({0: submap(range(1000), truth, 1.0), 1: (keys, colours)})
    assert gain_and_bias(found[1]) == pytest.approx((1.2, 0.0), abs=0.05)


def test_submap_without_overlap_keeps_its_exposure(truth):
    submaps = {0: submap(range(1000), truth, 1.0), 1: submap(range(2000, 3000), truth, 2.0)}
    assert estimate_exposures(submaps) == {0: IDENTITY, 1: IDENTITY}


def test_voxels_without_a_surface_are_ignored(truth):
    keys, colours = submap(range(1000), truth, 1.2)
    colours[::2] = np.nan
    found = estimate_exposures({0: submap(range(1000), truth, 1.0), 1: (keys, colours)})
    assert gain_and_bias(found[1]) == pytest.approx((1.2, 0.0), abs=0.01)


def test_white_balance_propagates_along_overlaps(truth):
    gains = np.array([1.2, 1.0, 0.8])
    submaps = {
        0: submap(range(1500), truth, 1.0, noise=0.02),
        3: submap(range(1000, 2500), truth, gains, noise=0.02, seed=1),
        5: submap(range(2000, 4000), truth, gains, noise=0.02, seed=2),
    }
    found = estimate_exposures(submaps)
    assert found[0] == IDENTITY
    for number in (3, 5):
        total = found[number].gain * np.array(found[number].balance)
        np.testing.assert_allclose(total / total[1], gains, atol=0.03)


def test_a_map_has_the_typical_exposure_of_its_keyframes():
    """The first image was exposed twice as long as the others, and has a blue cast."""
    bright = Exposure(2.0, 0.1, balance=(1.1, 1.0, 0.9))
    keyframes = {0: [IDENTITY, bright, bright], 1: [Exposure(1.25), Exposure(1.25)]}
    submaps = at_typical_exposure({0: IDENTITY, 1: Exposure(1.6)}, keyframes)
    of_keyframes = [submaps[n].after(e) for n in keyframes for e in keyframes[n]]
    gains = [exposure.gain for exposure in of_keyframes]
    assert gains == pytest.approx([0.5, 1.0, 1.0, 1.0, 1.0])
    assert np.median([exposure.bias for exposure in of_keyframes]) == pytest.approx(0.0, abs=0.06)


def test_small_differences_from_the_typical_exposure_are_ignored():
    assert typical_exposure([IDENTITY, Exposure(1.01, 0.015), Exposure(1.01)]) is IDENTITY
    assert typical_exposure([]) is IDENTITY
