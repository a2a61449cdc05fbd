"""Selection of a part of the Gaussians that looks like the whole."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.io.morton import morton_codes

# Distances to cameras count as at least this.
_NEAREST_M = 0.3
# Maximum factor by which Gaussians grow in place of their neighbours.
_MAX_GROWTH = 2.0
_ORDER_BITS = 10


@dataclass(frozen=True)
class Thinning:
    """A selection of Gaussians.

    Attributes:
        index: [M] indices of the selected Gaussians, the most visible first.
        growth: [M] factor of their standard deviation, >= 1.
    """

    index: NDArray[np.intp]
    growth: NDArray[np.float32]


def visibility(
    means_m: NDArray[np.float32],
    sigmas_m: NDArray[np.float32],
    opacities: NDArray[np.float32],
    cameras_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return opacity times apparent size [N] of Gaussians, as seen from the nearest camera.

    Args:
        means_m: [N, 3] centres.
        sigmas_m: [N] standard deviations.
        opacities: [N] in [0, 1].
        cameras_m: [K, 3] positions of cameras; without any, all distances are equal.
    """
    sizes: NDArray[np.float64] = opacities.astype(np.float64) * sigmas_m
    if not len(cameras_m):
        return sizes
    distances_m, _ = cKDTree(cameras_m).query(means_m)
    return sizes / np.maximum(distances_m, _NEAREST_M)


def thin(means_m: NDArray[np.float32], visible: NDArray[np.float64], count: int) -> Thinning:
    """Select `count` Gaussians with probabilities proportional to their visibility.

    Taking only the most visible ones would leave holes where small Gaussians represent detail.
    Gaussians are therefore sampled at even steps along a curve through the map, and one that stands
    for several neighbours grows accordingly. The selection is deterministic.

    Args:
        means_m: [N, 3] centres.
        visible: [N] visibility, >= 0.
        count: maximum number of Gaussians, >= 1.
    """
    if len(visible) <= count:
        order = np.argsort(-visible, kind="stable")
        return Thinning(order, np.ones(len(order), np.float32))
    probability = _probabilities(np.maximum(visible, 1e-12), count)
    along = _morton_order(means_m)
    steps = np.floor(np.cumsum(probability[along]) + 0.5)
    index = along[np.diff(steps, prepend=0.0) > 0][:count]
    index = index[np.argsort(-visible[index], kind="stable")]
    growth = np.minimum(1.0 / np.sqrt(probability[index]), _MAX_GROWTH)
    return Thinning(index, growth.astype(np.float32))


def _probabilities(weights: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return probabilities [N] <= 1 proportional to weights, with the sum `count`."""
    factor = count / weights.sum()
    # Weights above 1 are certain, and the others share what is left; this converges from below.
    for _ in range(30):
        certain = factor * weights >= 1.0
        rest = weights[~certain].sum()
        if rest == 0.0:
            break
        factor = (count - certain.sum()) / rest
    return np.minimum(factor * weights, 1.0)


def _morton_order(means_m: NDArray[np.float32]) -> NDArray[np.intp]:
    low_m = means_m.min(axis=0)
    side_m = max(float((means_m.max(axis=0) - low_m).max()), 1e-9)
    return np.argsort(morton_codes(means_m, low_m, side_m, _ORDER_BITS), kind="stable")
