"""Frames by which the checks of a recording judge it are read once."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from moving_room import CAMERA, write_recording

from toolkit.datasets.agreement.findings import contradictions
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.carrier import without_carrier
from toolkit.datasets.registry import describe
from toolkit.datasets.samples import SmallFrames, spread_frames
from toolkit.io import images

FRAMES = 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_recording(tmp_path_factory.mktemp("samples") / "box", np.arange(FRAMES) / 20.0)


@pytest.fixture
def recording(folder):
    return describe("folder", folder)


@pytest.fixture
def reads(monkeypatch):
    """How often each image file is read."""
    counted, read = Counter(), images._read
    monkeypatch.setattr(
        images, "_read", lambda path, *limits: counted.update([path]) or read(path, *limits)
    )
    return counted


def test_all_checks_decode_a_file_once(recording, reads):
    dataset = RecordedDataset(without_carrier(recording))
    assert len(list(spread_frames(dataset))) == 16
    contradictions(dataset)
    # Both images of frames all over the recording, and of eight groups of five.
    assert max(reads.values()) == 1
    assert 2 * 16 < len(reads) <= 2 * (16 + 40)


def test_kept_images_give_the_same_frames(recording):
    dataset = RecordedDataset(recording)
    first, again = (list(spread_frames(dataset)) for _ in range(2))
    for frames in (first, again):
        for frame in frames:
            read = dataset[frame.index]
            np.testing.assert_array_equal(frame.rgb, read.rgb)
            np.testing.assert_array_equal(frame.depth_m, read.depth_m)
    nearer = RecordedDataset(replace(recording, depth_scale=2 * recording.depth_scale))
    np.testing.assert_array_equal(next(spread_frames(nearer)).depth_m, 0.5 * first[0].depth_m)


def test_frames_that_are_processed_are_read_again(recording, reads):
    dataset = RecordedDataset(recording)
    frames = list(spread_frames(dataset))
    before = reads.total()
    list(spread_frames(dataset))
    assert reads.total() == before
    dataset[frames[0].index]
    assert reads.total() == before + 2
    recording.kept.clear()
    list(spread_frames(dataset))
    assert reads.total() == 2 * before + 2


def test_what_cannot_be_read_is_left_out(recording, tmp_path):
    damaged = replace(recording.files[0], rgb=tmp_path / "missing.png")
    dataset = RecordedDataset(replace(recording, files=(damaged, *recording.files[1:])))
    assert next(spread_frames(dataset)).index > 0
    small = SmallFrames(dataset)
    assert small.get(0) is None and small.get(FRAMES) is None
    assert small.get(1).camera == CAMERA
    colour = tuple(replace(files, depth=None) for files in recording.files)
    assert not list(spread_frames(RecordedDataset(replace(recording, files=colour))))


@pytest.mark.parametrize(("count", "anchors"), [(3, [0]), (12, [0, 1, 2, 3]), (30, [0, 21])])
def test_compared_frames_reach_the_end(recording, count, anchors):
    found = SmallFrames(RecordedDataset(recording, max_frames=count)).anchors(8)
    assert {*anchors} <= {*found} and found[-1] == anchors[-1]
