"""How close rendered depth is to measured depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class DepthError:
    """Mean absolute depth difference of one view.

    Attributes:
        l1_m: mean of |rendered - measured| in metres over the pixels counted, None if
            there are none.
        pixels: pixels counted: measured and rendered depth are both valid.
        coverage: share of the pixels with measured depth that were counted, in [0, 1];
            a map full of holes has a small error and a small coverage.
    """

    l1_m: float | None
    pixels: int
    coverage: float


def depth_l1(rendered_m: NDArray, measured_m: NDArray) -> DepthError:
    """L1 of depth where both images hold some; holes count in the coverage alone.

    SplaTAM and Hier-SLAM count holes of the measurement as perfect pixels, which makes
    their figure smaller by the share of holes.

    Args:
        rendered_m: [H, W] z-depth divided by the silhouette, metres; 0 or not finite
            where nothing was rendered.
        measured_m: [H, W] z-depth in metres; 0 or not finite where missing.

    Raises:
        ValueError: shapes differ.
    """
    if rendered_m.shape != measured_m.shape or rendered_m.ndim != 2:
        raise ValueError(
            f"depth images must both have shape [H, W], got {list(rendered_m.shape)} and "
            f"{list(measured_m.shape)}"
        )
    measured = _is_valid(measured_m)
    counted = measured & _is_valid(rendered_m)
    pixels = int(counted.sum())
    if pixels == 0:
        return DepthError(None, 0, 0.0)
    difference = rendered_m[counted].astype(np.float64) - measured_m[counted]
    return DepthError(float(np.abs(difference).mean()), pixels, pixels / int(measured.sum()))


def _is_valid(depth_m: NDArray) -> NDArray[np.bool_]:
    return np.isfinite(depth_m) & (depth_m > 0)
