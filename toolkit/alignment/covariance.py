"""Information of an alignment from the structure of its residuals.

Gauss-Newton information counts each pixel as an independent measurement. Neighbouring residuals
are correlated (calibration, exposure, depth errors of whole surfaces, errors of a map), so it is
too large by orders of magnitude, and by a factor that depends on the scene. The cluster-robust
("sandwich") covariance of Liang and Zeger (1986) measures the correlation instead: the gradients
of the cost are summed over image blocks, and only the sums of different blocks are taken as
independent,

    covariance = H^-1 (sum_b g_b g_b^T) H^-1 * B / (B - p)    (B blocks, p parameters).

Where residuals of a block are independent, the expectation is H^-1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import FrameLevel
from toolkit.alignment.joint import Eliminated, Estimate, Pair, linearised
from toolkit.alignment.options import JointOptions

Array = NDArray[np.float64]

# Blocks of a view.
_ROWS, _COLUMNS = 4, 6
_PARAMETERS = 6


def clustered_information(
    pairs: Sequence[Pair], estimate: Estimate, options: JointOptions
) -> Array:
    """Information [6, 6] of x in T_target_source exp(x) at the estimate.

    Zero where the blocks with residuals are too few to determine a covariance.
    """
    linears = linearised(pairs, 0, estimate, options)
    gradients = []
    H = np.zeros((6, 6))
    for k, (pair, linear) in enumerate(zip(pairs, linears, strict=True)):
        whole = Eliminated.of(pair, linear, estimate, options.exposure)
        H += whole.H
        own = replace(estimate, exposures=estimate.exposures[k : k + 1])
        for block in _blocks(pair.frame[0]):
            part = linearised([replace(pair, frame=[block])], 0, own, options)[0]
            if part.depth_pixels + part.intensity_pixels > 0:
                gradients.append(whole.gradient(part.g))
    excess = len(gradients) - _PARAMETERS
    if excess < 1:
        return np.zeros((6, 6))
    middle = np.einsum("bi,bj->ij", gradients, gradients) * len(gradients) / excess
    # Residuals smaller than expected in every block do not make pixels more than independent.
    covariance_inverse = H @ np.linalg.solve(middle + H, H)
    return np.asarray(0.5 * (covariance_inverse + covariance_inverse.T))


def _blocks(level: FrameLevel) -> Iterator[FrameLevel]:
    """A view cut into blocks."""
    camera = level.camera
    rows = np.linspace(0, camera.height, min(_ROWS, camera.height) + 1).astype(int)
    columns = np.linspace(0, camera.width, min(_COLUMNS, camera.width) + 1).astype(int)
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            yield FrameLevel(
                camera.cropped(int(left), int(top), int(right - left), int(bottom - top)),
                level.intensity[top:bottom, left:right].contiguous(),
                level.depth_m[top:bottom, left:right].contiguous(),
            )
