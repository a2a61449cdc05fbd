"""Frames read ahead are the same frames, and no thread stays behind."""

import threading
import time

import numpy as np
import pytest

from toolkit.datasets.prefetch import prefetched
from toolkit.errors import DatasetError
from toolkit.frame import Frame
from toolkit.geometry.camera import Camera

CAMERA = Camera(10, 10, 2, 2, 4, 4)


class CountingDataset:
    """Hands out blank frames, remembers which, and fails at one of them."""

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


def test_frames_come_in_the_order_asked_for():
    frames = prefetched(CountingDataset(), [3, 1, 4, 1, 5])
    assert [frame.index for frame in frames] == [3, 1, 4, 1, 5]
    assert readers() == 0


def test_no_more_than_asked_is_read_ahead():
    dataset = CountingDataset()
    frames = prefetched(dataset, range(100), ahead=2)
    next(frames)
    time.sleep(0.1)
    # One handed out, two in the queue, one in the reader's hands.
    assert len(dataset.read) <= 4
    frames.close()
    assert readers() == 0


def test_an_error_arrives_in_the_place_of_its_frame():
    frames = prefetched(CountingDataset(broken=2), range(10))
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(DatasetError, match="frame 2 is corrupt"):
        next(frames)
    assert readers() == 0


def test_nothing_asked_nothing_given():
    assert list(prefetched(CountingDataset(), [])) == []


def test_frames_are_prepared_in_order_before_they_are_handed_over():
    prepared = []
    frames = prefetched(CountingDataset(), [3, 1, 4], prepare=prepared.append)
    for frame in frames:
        assert any(frame is seen for seen in prepared)
    assert [frame.index for frame in prepared] == [3, 1, 4]


def test_an_error_of_preparing_arrives_too():
    def fail(frame: Frame) -> None:
        raise ValueError(f"frame {frame.index} is too small")

    with pytest.raises(ValueError, match="frame 7 is too small"):
        next(prefetched(CountingDataset(), [7], prepare=fail))
    assert readers() == 0
