"""Frames that cannot be read are lost; a run continues without them."""

import pytest

from toolkit.base.errors import DatasetError
from toolkit.datasets.faults import fault_tolerant
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset


@pytest.fixture
def damaged(make_replica):
    """Opens a recording of some frames, of which those with given indices are truncated."""

    def make(frames: int, *broken: int):
        folder = make_replica(frames=frames)
        for index in broken:
            file = folder / f"results/depth{index:06d}.png"
            file.write_bytes(file.read_bytes()[:-30])
        return fault_tolerant(open_dataset("replica", folder))

    return make


def test_a_damaged_frame_is_black_and_says_why(damaged):
    frames = list(prefetched(damaged(5, 2), range(5)))
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [bool(frame.fault) for frame in frames] == [False, False, True, False, False]
    assert "depth000002.png is truncated; copy or convert it again" in frames[2].fault
    assert not frames[2].rgb.any()
    assert not frames[2].depth_m.any()
    assert frames[1].timestamp_s < frames[2].timestamp_s < frames[3].timestamp_s


def test_a_damaged_first_frame_is_an_error(damaged):
    with pytest.raises(DatasetError, match=r"depth000000\.png is truncated"):
        damaged(3, 0)[0]


def test_damaged_frames_are_counted_in_a_row(damaged):
    frames = damaged(14, *range(1, 6), *range(7, 10), *range(11, 14))
    assert sum(bool(frames[i].fault) for i in range(14)) == 11


def test_ten_damaged_frames_in_a_row_are_an_error(damaged):
    frames = damaged(14, *range(2, 14))
    assert all(frames[i].fault for i in range(2, 11))
    with pytest.raises(DatasetError, match=r"depth000011\.png is truncated"):
        frames[11]
