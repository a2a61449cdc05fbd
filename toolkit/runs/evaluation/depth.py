"""Error of rendered depth against measured depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DepthError:
    """Mean absolute depth difference of one view.

    Attributes:
        l1_m: mean of |rendered - measured| in metres over the valid pixels, None if there are
            none.
        coverage: fraction of the pixels with measured depth that are valid, in [0, 1]. A map
            with many holes may have a small error, but has a small coverage.
    """

    l1_m: float | None
    coverage: float


def depth_l1(rendered_m: NDArray, measured_m: NDArray) -> DepthError:
    """Compute the L1 depth error over pixels where both depths are valid.

    Pixels without rendered depth only reduce the coverage. SplaTAM and Hier-SLAM count pixels
    without measured depth as pixels without error, which makes their values smaller.

    Args:
        rendered_m: [H, W] z-depth divided by the silhouette, in metres; 0 or non-finite where
            nothing was rendered.
        measured_m: [H, W] z-depth in metres; 0 or non-finite where missing.
    """
    measured = _is_valid(measured_m)
    valid = measured & _is_valid(rendered_m)
    pixels = int(valid.sum())
    if pixels == 0:
        return DepthError(None, 0.0)
    difference = rendered_m[valid].astype(np.float64) - measured_m[valid]
    return DepthError(float(np.abs(difference).mean()), pixels / int(measured.sum()))


def _is_valid(depth_m: NDArray) -> NDArray[np.bool_]:
    return np.isfinite(depth_m) & (depth_m > 0)
