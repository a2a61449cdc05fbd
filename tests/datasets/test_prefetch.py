"""Prefetching yields the same frames and ends its thread."""

import threading
import time

import numpy as np
import pytest

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.prefetch import prefetched

CAMERA = Camera(10, 10, 2, 2, 4, 4)


class CountingDataset:
    """Dataset of blank frames that records accesses and fails at one of them."""

    def __init__(self, broken: int | None = None) -> None:
        self.read: list[int] = []
        self.broken = broken

    def __getitem__(self, index: int) -> Frame:
        if index == self.broken:
            raise DatasetError(f"frame {index} is corrupt")
        self.read.append(index)
        blank = np.zeros((4, 4), np.float32)
        return Frame(index, float(index), np.zeros((4, 4, 3), np.float32), blank, CAMERA)


def readers() -> int:
    return sum(thread.name == "prefetch" for thread in threading.enumerate())


def test_frames_are_in_the_requested_order():
    frames = prefetched(CountingDataset(), [3, 1, 4, 1, 5])
    assert [frame.index for frame in frames] == [3, 1, 4, 1, 5]
    assert readers() == 0


def test_number_of_prefetched_frames_is_limited():
    dataset = CountingDataset()
    frames = prefetched(dataset, range(100), ahead=2)
    next(frames)
    time.sleep(0.1)
    # One yielded, two in the queue, one held by the reader.
    assert len(dataset.read) <= 4
    frames.close()
    assert readers() == 0


def test_exception_is_raised_in_place_of_its_frame():
    frames = prefetched(CountingDataset(broken=2), range(10))
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(DatasetError, match="frame 2 is corrupt"):
        next(frames)
    assert readers() == 0


def test_no_indices_yield_no_frames():
    assert list(prefetched(CountingDataset(), [])) == []


def test_frames_are_prepared_in_order_before_they_are_yielded():
    prepared = []
    frames = prefetched(CountingDataset(), [3, 1, 4], prepare=prepared.append)
    for frame in frames:
        assert any(frame is seen for seen in prepared)
    assert [frame.index for frame in prepared] == [3, 1, 4]


def test_exception_of_prepare_is_raised():
    def fail(frame: Frame) -> None:
        raise ValueError(f"frame {frame.index} is too small")

    with pytest.raises(ValueError, match="frame 7 is too small"):
        next(prefetched(CountingDataset(), [7], prepare=fail))
    assert readers() == 0
