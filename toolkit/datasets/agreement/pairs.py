"""Pairs of frames of a recording that show the same surfaces, and their relative poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.samples import GAPS, SmallFrames
from toolkit.datasets.shutter.alignment import MovingView, RelativePose, ShutterTimes, align
from toolkit.datasets.shutter.levels import ShutterLevel, shutter_levels

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

# Minimum part of the first frame that the second one must show.
_MIN_SHARED, _MAX_DISTANCE = 0.5, 0.08


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames and the motion between them that their depth and colour show.

    Attributes:
        first, second: indices of the frames.
        levels: small images of both.
        pose: T_second_first [4, 4] and the exposure of the second one.
        labels: class ids [H, W] of both at their level, 0 void; None if a frame has none.
    """

    first: int
    second: int
    levels: tuple[ShutterLevel, ShutterLevel]
    pose: RelativePose
    labels: tuple[Labels, Labels] | None = None

    @property
    def depth_m(self) -> float:
        """Median depth of the first frame, metres."""
        return float(np.median(self.levels[0].samples[:, 2]))


def aligned_pairs(frames: SmallFrames) -> list[FramePair]:
    """Evenly spaced frames, each with up to four later ones that can be aligned to it."""
    return [pair for anchor in frames.anchors(GAPS[-1]) for pair in _later(frames, anchor, GAPS)]


def aligned_pair(frames: SmallFrames, index: int) -> FramePair | None:
    """A frame and the next one; None if they cannot be aligned."""
    return next(_later(frames, index, (1,)), None)


def _later(frames: SmallFrames, anchor: int, gaps: Sequence[int]) -> Iterator[FramePair]:
    """Align later frames to one, until that fails; each starts at the motion of the one before."""
    first = frames.get(anchor)
    if first is None:
        return
    here, pose = MovingView(shutter_levels(first), np.zeros(6)), RelativePose(np.eye(4))
    for gap in gaps:
        second = frames.get(anchor + gap)
        if second is None:
            return
        there = MovingView(shutter_levels(second), np.zeros(6))
        found = align(here, there, pose, ShutterTimes(), coarse=True)
        if found is None:
            return
        a, b = here.levels[0], there.levels[0]
        if samples_in_second(a, b, found.T_second_first, _MAX_DISTANCE).seen.mean() < _MIN_SHARED:
            return
        pose = found
        labels = None
        if first.labels is not None and second.labels is not None:
            labels = first.labels, second.labels
        yield FramePair(anchor, anchor + gap, (a, b), found, labels)


@dataclass(frozen=True, eq=False)
class SeenSamples:
    """Where a frame sees the samples of another one.

    Attributes:
        seen: [N] bool, whether they lie on surfaces of the frame.
        rows, columns: [N] their pixels; 0 outside of the image.
    """

    seen: NDArray[np.bool_]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]


def samples_in_second(
    first: ShutterLevel, second: ShutterLevel, T_second_first: Array, max_distance: float
) -> SeenSamples:
    """Find the samples of the first frame in the second one.

    Args:
        T_second_first: [4, 4].
        max_distance: of a sample from the surface, relative to its depth.
    """
    camera = second.camera
    x, y, z = (first.samples @ T_second_first[:3, :3].T + T_second_first[:3, 3]).T
    z = np.maximum(z, 1e-3)
    u = np.rint(camera.fx * x / z + camera.cx).astype(int)
    v = np.rint(camera.fy * y / z + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    seen = inside & (np.abs(second.points[v, u, 2] - z) < max_distance * z)
    return SeenSamples(seen, v, u)
