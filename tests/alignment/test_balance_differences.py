"""White balance of images relative to each other: pairs of images, and chains of pairs."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.splatting.alignment.reference import LUMA
from toolkit.splatting.alignment.white_balance import (
    BalanceDifference,
    BalanceLink,
    balance_difference,
    balance_gains,
    is_neutral,
    solve_balances,
)

GAINS = np.array([1.2, 1.0, 0.8])


def log_balance(gains: np.ndarray) -> np.ndarray:
    return np.log(gains) - np.log(gains).mean()


def surface(count: int = 2000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.15, 0.7, (count, 3))


def test_known_gains_are_recovered_beside_exposure_shading_and_noise():
    colours, rng = surface(), np.random.default_rng(1)
    shading = rng.uniform(0.6, 1.3, (len(colours), 1))
    second = 1.4 * shading * colours / GAINS
    noisy = [image + rng.normal(0.0, 0.01, colours.shape) for image in (colours, second)]
    found = balance_difference(*noisy)
    np.testing.assert_allclose(found.log_gains, log_balance(GAINS), atol=0.005)


def test_a_pair_is_symmetric():
    rng = np.random.default_rng(1)
    first, second = (surface() + rng.normal(0.0, 0.05, (2000, 3)) for _ in range(2))
    there, back = balance_difference(first, second), balance_difference(second, first)
    np.testing.assert_allclose(there.log_gains, -back.log_gains, atol=1e-12)


def test_changed_surfaces_are_outliers():
    first = surface()
    second = first / GAINS
    second[:600] = surface(600, seed=3)
    found = balance_difference(first, second)
    np.testing.assert_allclose(found.log_gains, log_balance(GAINS), atol=0.03)


@pytest.mark.parametrize("hue", [(0.6, 0.03, 0.03), (0.02, 0.02, 0.02)])
def test_dark_channels_determine_nothing(hue):
    second = np.tile(hue, (2000, 1))
    first = second + np.array([0.0, 0.02, 0.0])
    assert balance_difference(first, second) is None


def test_later_pairs_do_not_add_up_along_a_loop():
    rng = np.random.default_rng(0)
    truth = np.array([0.2 * np.sin(k / 6) * np.array([1.0, 0.0, -1.0]) for k in range(40)])
    links = [
        BalanceLink(a, b, BalanceDifference(truth[b] - truth[a] + rng.normal(0.0, 0.003, 3), 0.9))
        for b in range(40)
        for a in (b - 1, b - 2, b - 3, b - 37)
        if a >= 0
    ]
    # Thirty times the noise, in a pair that compares different surfaces.
    links.append(BalanceLink(3, 20, BalanceDifference(np.array([0.1, 0.0, -0.1]), 0.9)))
    found = solve_balances(np.zeros((1, 3)), 40, links)
    np.testing.assert_allclose(found, truth, atol=0.012)


def test_the_minority_of_links_is_the_outlier_however_large_the_difference():
    difference = np.array([0.3, 0.0, -0.3])
    measured = [difference, difference, np.zeros(3)]
    links = [BalanceLink(0, 1, BalanceDifference(log_gains, 0.9)) for log_gains in measured]
    found = solve_balances(np.zeros((1, 3)), 2, links)
    np.testing.assert_allclose(found[1], difference, atol=0.01)


def test_drift_is_bounded_without_loops():
    """A constant error of every pair would otherwise add up to 0.5."""
    links = [
        BalanceLink(k, k + 1, BalanceDifference(np.array([1e-3, 0.0, -1e-3]), 0.9))
        for k in range(500)
    ]
    found = solve_balances(np.zeros((1, 3)), 501, links)
    assert 0.05 < np.abs(found).max() < 0.2


def test_images_without_pairs_stay_neutral():
    np.testing.assert_array_equal(solve_balances(np.zeros((1, 3)), 3, []), np.zeros((3, 3)))


def test_gains_keep_the_mean_intensity():
    mean = np.array([0.2, 0.4, 0.7])
    gains = np.array(balance_gains(log_balance(GAINS), mean))
    assert LUMA @ (gains * mean) == pytest.approx(LUMA @ mean)
    np.testing.assert_allclose(gains / gains[1], GAINS)


def test_small_changes_are_neutral():
    assert is_neutral(np.array([0.005, 0.0, -0.005]), 0.01)
    assert not is_neutral(np.array([0.0, 0.02, -0.02]), 0.01)
    assert not is_neutral(np.zeros(3), 0.0)
