"""Pairs of frames of a recording that show the same surfaces, and their relative poses."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.prefetch import read_ahead
from toolkit.datasets.shutter.alignment import MovingView, RelativePose, ShutterTimes, align
from toolkit.datasets.shutter.levels import ShutterLevel, shutter_levels
from toolkit.errors import ToolkitError

Array = NDArray[np.float64]
# Small images of a frame, the larger ones first.
_Levels = tuple[ShutterLevel, ShutterLevel]

_WIDTH = 160
# Frames that later ones are aligned to, and by how many frames these are later. Each alignment
# starts at the motion of the one before.
_ANCHORS, _GAPS = 8, (1, 3, 8, 20)
# Minimum part of the first frame that the second one must show.
_MIN_SHARED, _MAX_DISTANCE = 0.5, 0.08


@dataclass(frozen=True, eq=False)
class FramePair:
    """Two frames and the motion between them that their depth and colour show.

    Attributes:
        first, second: indices of the frames.
        levels: small images of both.
        pose: T_second_first [4, 4] and the exposure of the second one.
    """

    first: int
    second: int
    levels: tuple[ShutterLevel, ShutterLevel]
    pose: RelativePose

    @property
    def depth_m(self) -> float:
        """Median depth of the first frame, metres."""
        return float(np.median(self.levels[0].samples[:, 2]))


def aligned_pairs(dataset: RecordedDataset) -> list[FramePair]:
    """Evenly spaced frames, each with up to four later ones that can be aligned to it."""
    small = _small(dataset)
    last = max(len(dataset) - 1 - max(_GAPS), 0)
    anchors = np.unique(np.linspace(0, last, _ANCHORS).astype(int)).tolist()
    # Frames are read while those before are aligned.
    read = read_ahead(lambda anchor: _read(small, anchor, _GAPS), anchors, ahead=1)
    found = (_later(n, _GAPS, levels) for n, levels in zip(anchors, read, strict=True))
    return list(itertools.chain.from_iterable(found))


def aligned_pair(dataset: RecordedDataset, index: int) -> FramePair | None:
    """A frame and the next one; None if they cannot be aligned."""
    return next(_later(index, (1,), _read(_small(dataset), index, (1,))), None)


def _small(dataset: RecordedDataset) -> RecordedDataset:
    """The frames of a dataset, as small as is enough for their motion."""
    recording = dataset.recording
    return RecordedDataset(recording, recording.camera.size_up_to(_WIDTH), len(dataset))


def _read(dataset: RecordedDataset, anchor: int, gaps: Sequence[int]) -> list[_Levels | None]:
    """Small images of a frame and of later ones."""
    return [_levels(dataset, anchor + gap) for gap in (0, *gaps)]


def _later(
    anchor: int, gaps: Sequence[int], levels: Sequence[_Levels | None]
) -> Iterator[FramePair]:
    """Align the second and further frames to the first one, until that fails."""
    first, *others = levels
    pose = RelativePose(np.eye(4))
    for gap, second in zip(gaps, others, strict=True):
        if first is None or second is None:
            return
        here, there = MovingView(first, np.zeros(6)), MovingView(second, np.zeros(6))
        found = align(here, there, pose, ShutterTimes(), coarse=True)
        if found is None or _shared(first[0], second[0], found.T_second_first) < _MIN_SHARED:
            return
        pose = found
        yield FramePair(anchor, anchor + gap, (first[0], second[0]), found)


def _shared(first: ShutterLevel, second: ShutterLevel, T_second_first: Array) -> float:
    """Part of the first frame's samples that lie on surfaces of the second one."""
    camera = second.camera
    x, y, z = (first.samples @ T_second_first[:3, :3].T + T_second_first[:3, 3]).T
    z = np.maximum(z, 1e-3)
    u = np.rint(camera.fx * x / z + camera.cx).astype(int)
    v = np.rint(camera.fy * y / z + camera.cy).astype(int)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    depth = second.points[np.where(inside, v, 0), np.where(inside, u, 0), 2]
    return float(np.mean(inside & (np.abs(depth - z) < _MAX_DISTANCE * z)))


def _levels(dataset: RecordedDataset, index: int) -> _Levels | None:
    """Small images of a frame; None if there is none, or if it cannot be read."""
    if index >= len(dataset):
        return None
    try:
        return shutter_levels(dataset[index])
    except ToolkitError:
        return None  # reported when the frame is processed
