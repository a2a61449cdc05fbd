"""Depth values that mean "no measurement", found from the depth images of a recording.

Cameras and converters write 0 where nothing was measured, and some a constant far value: the
largest one of the type, or the end of the range. Taken as a distance, it is a wall of the room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.base import Recording
from toolkit.io import images

# A surface has a neighbour in depth; the value of no measurement is at least so many times as far
# as everything else, in at least two frames, and takes at least this share of the pixels.
_MIN_RATIO, _MIN_FRAMES, _MIN_SHARE = 2.0, 2, 0.001
# Readings of one value are equal up to the rounding of their conversion to metres.
_SAME = 1e-4


@dataclass(frozen=True)
class FarValue:
    """A constant value beyond all others.

    Attributes:
        value: in the unit of the images.
        share: of the pixels that are not 0.
    """

    value: float
    share: float


def far_value(depths: Sequence[NDArray]) -> FarValue | None:
    """The constant far value of some depth images [H, W] (0 where missing); None without any."""
    value = max((float(depth.max()) for depth in depths), default=0.0)
    if value <= 0.0:
        return None
    equal = [depth >= np.float32(value * (1.0 - _SAME)) for depth in depths]
    others = zip(depths, equal, strict=True)
    farthest = max(float(depth[~same].max(initial=0)) for depth, same in others)
    counts = np.array([np.count_nonzero(same) for same in equal])
    share = float(counts.sum() / sum(np.count_nonzero(depth > 0) for depth in depths))
    is_apart = 0.0 < _MIN_RATIO * farthest <= value
    if not is_apart or np.count_nonzero(counts) < _MIN_FRAMES or share < _MIN_SHARE:
        return None
    return FarValue(value, share)


def without_far_value(recording: Recording, depths: Sequence[NDArray]) -> Recording:
    """The recording with the far value of its depth, and a note about what counts as missing.

    Args:
        recording: with depth.
        depths: depth values of some of its frames, as of `depth_samples`.
    """
    if not depths:
        return recording
    notes = []
    if recording.container is None:
        saturated = float(np.mean([np.mean(d == images.SATURATED_DEPTH) for d in depths]))
        if saturated > 0:
            notes.append(
                f"{100 * saturated:.2g} % of the depth pixels have the largest value of their "
                f"type, {images.SATURATED_DEPTH}; they count as missing"
            )
        depths = [np.where(d == images.SATURATED_DEPTH, 0, d) for d in depths]
    found = far_value(depths)
    if found is None:
        return replace(recording, notes=(*recording.notes, *notes))
    metres = found.value / (recording.depth_scale if recording.container is None else 1.0)
    notes.append(
        f"{100 * found.share:.2g} % of the depth pixels have one constant value of {metres:.4g} m, "
        f"far behind all others; they count as missing"
    )
    far_m = metres * (1.0 - _SAME)
    return replace(recording, missing_from_m=far_m, notes=(*recording.notes, *notes))
