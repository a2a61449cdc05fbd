"""Standard deviations of estimates from a few groups of observations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def jackknife_sigmas(without: Array) -> Array:
    """Standard deviations [...] of an estimate from those without each of N groups, [N, ...]."""
    squares = ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((1.0 - 1.0 / len(without)) * squares), np.float64)
