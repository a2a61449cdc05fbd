"""Gains of the colour channels between a rendered and an observed view.

Automatic white balance changes each channel by its own factor, which one gain and one bias for all
channels cannot follow. Least squares maximise the PSNR of the view; the gains that a run applies to
its images must not depend on noise, and are estimated in `toolkit.alignment.white_balance`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Pulls gains towards 1, in mean squares of colours in [0, 1]: a dark channel determines no gain.
_PRIOR = 1e-3
# Largest residual of a pixel that the gains are fitted to; larger ones are errors of the map.
_MAX_RESIDUAL = 0.15
_ROUNDS = 3


def balanced(rendered: Array, observed: Array) -> Array:
    """The rendered colours [H, W, 3], with one gain per channel that fits the observed ones."""
    gains = np.ones(3)
    for _ in range(_ROUNDS):
        good = (np.abs(gains * rendered - observed) < _MAX_RESIDUAL).all(axis=-1)
        r, o = rendered[good].astype(np.float64), observed[good].astype(np.float64)
        count = max(len(rendered.reshape(-1, 3)), 1)
        prior = _PRIOR * count
        gains = ((r * o).sum(axis=0) + prior) / ((r * r).sum(axis=0) + prior)
    return (gains * rendered).clip(0.0, 1.0).astype(np.float32)
