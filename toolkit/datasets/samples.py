"""Frames of a recording by which its checks judge it; each is read and decoded once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np

from toolkit.base.caching import LruCache
from toolkit.base.errors import ToolkitError
from toolkit.base.frame import Frame
from toolkit.datasets.base import RecordedDataset

# Frames that show all of a recording.
_SPREAD = 16
# Motion is seen in images of this width, of which at most so many are kept.
SMALL_WIDTH, _SMALL_FRAMES = 160, 64
# Frames with which others are compared, and by how many frames these are later.
_ANCHORS, GAPS = 8, (1, 3, 8, 20)


def evenly_spaced(count: int, most: int) -> list[int]:
    """Indices of at most a number of frames, of `count`, from the first one to the last."""
    return [int(n) for n in np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))]


def readable(read: Callable[[int], Frame], indices: Iterable[int]) -> Iterator[Frame]:
    """Frames of a recording that can be read; others are reported when they are processed."""
    for index in indices:
        try:
            yield read(index)
        except ToolkitError:
            continue


def spread_frames(dataset: RecordedDataset) -> Iterator[Frame]:
    """Evenly spaced frames of a recording that can be read; none without depth."""
    if dataset.files(0).depth is not None:
        yield from readable(
            partial(dataset.sample, keep=True), evenly_spaced(len(dataset), _SPREAD)
        )


class SmallFrames:
    """Frames of a recording, as small as is enough for their motion.

    Attributes:
        dataset: the recording at that size.
    """

    def __init__(self, dataset: RecordedDataset) -> None:
        recording = dataset.recording
        size = recording.camera.size_up_to(SMALL_WIDTH)
        self.dataset = RecordedDataset(recording, size, len(dataset))
        self._frames: LruCache[Frame | None] = LruCache(_SMALL_FRAMES)

    def __len__(self) -> int:
        return len(self.dataset)

    def anchors(self, reach: int) -> list[int]:
        """Evenly spaced frames with so many later ones, with which they are compared."""
        return evenly_spaced(max(len(self) - reach, 1), _ANCHORS)

    def get(self, index: int) -> Frame | None:
        """A frame; None if there is none, or if it cannot be read."""
        if index >= len(self):
            return None
        read = readable(partial(self.dataset.sample, keep=False), [index])
        return self._frames.get(index, lambda: next(read, None))
