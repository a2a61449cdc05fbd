"""Which frames become keyframes, and which keyframes a mapping call optimises."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from toolkit.keyframe import Keyframe


class KeyframeChoice(Protocol):
    """Decides which tracked frames become keyframes; by default a `KeyframePolicy`."""

    def wants(self, frames_since_last: int, overlap: float) -> bool:
        """Whether the newest frame should become a keyframe; see `KeyframePolicy.wants`."""
        ...


def choose_window(
    keyframes: list[Keyframe],
    size: int,
    min_overlap: float,
    generator: np.random.Generator,
) -> list[Keyframe]:
    """Choose the newest keyframe and up to `size - 1` random keyframes that overlap with it.

    Args:
        keyframes: at least one, in order.
        size: maximum number of keyframes in the window.
        min_overlap: minimum fraction of the newest keyframe's points visible in the others.
        generator: chooses among the overlapping keyframes.
    """
    newest = keyframes[-1]
    others = keyframes[:-1]
    poses = np.array([k.T_map_camera for k in others]).reshape(-1, 4, 4)
    overlaps = newest.fractions_seen_by(poses)
    overlapping = [k for k, overlap in zip(others, overlaps, strict=True) if overlap > min_overlap]
    count = min(size - 1, len(overlapping))
    chosen = (
        [overlapping[i] for i in generator.choice(len(overlapping), count, replace=False)]
        if count
        else []
    )
    return [newest, *chosen]
