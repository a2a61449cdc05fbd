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
Labels = NDArray[np.int32]

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


def aligned_pairs(dataset: RecordedDataset) -> list[FramePair]:
    """Evenly spaced frames, each with up to four later ones that can be aligned to it."""
    small = _small(dataset)
    last = max(len(dataset) - 1 - max(_GAPS), 0)
    anchors = np.unique(np.linspace(0, last, _ANCHORS).astype(int)).tolist()
    # Frames are read while those before are aligned.
    read = read_ahead(lambda anchor: _read(small, anchor, _GAPS), anchors, ahead=1)
    found = (_later(n, _GAPS, frames) for n, frames in zip(anchors, read, strict=True))
    return list(itertools.chain.from_iterable(found))


def aligned_pair(dataset: RecordedDataset, index: int) -> FramePair | None:
    """A frame and the next one; None if they cannot be aligned."""
    return next(_later(index, (1,), _read(_small(dataset), index, (1,))), None)


def _small(dataset: RecordedDataset) -> RecordedDataset:
    """The frames of a dataset, as small as is enough for their motion."""
    recording = dataset.recording
    return RecordedDataset(recording, recording.camera.size_up_to(_WIDTH), len(dataset))


def _read(dataset: RecordedDataset, anchor: int, gaps: Sequence[int]) -> list[_SmallFrame | None]:
    """A frame and later ones."""
    return [_small_frame(dataset, anchor + gap) for gap in (0, *gaps)]


def _later(
    anchor: int, gaps: Sequence[int], frames: Sequence[_SmallFrame | None]
) -> Iterator[FramePair]:
    """Align the second and further frames to the first one, until that fails."""
    first, *others = frames
    pose = RelativePose(np.eye(4))
    for gap, second in zip(gaps, others, strict=True):
        if first is None or second is None:
            return
        here, there = (MovingView(frame.levels, np.zeros(6)) for frame in (first, second))
        found = align(here, there, pose, ShutterTimes(), coarse=True)
        if found is None:
            return
        a, b = first.levels[0], second.levels[0]
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


@dataclass(frozen=True, eq=False)
class _SmallFrame:
    """Small images of a frame, and its labels at the size of the first one."""

    levels: tuple[ShutterLevel, ShutterLevel]
    labels: Labels | None


def _small_frame(dataset: RecordedDataset, index: int) -> _SmallFrame | None:
    """A frame; None if there is none, or if it cannot be read."""
    if index >= len(dataset):
        return None
    try:
        frame = dataset[index]
    except ToolkitError:
        return None  # reported when the frame is processed
    return _SmallFrame(shutter_levels(frame), frame.labels)
