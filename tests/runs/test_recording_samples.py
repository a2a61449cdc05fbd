"""A run knows the frames of its recording again, at any size and compression."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.runs.recording_samples import is_same_recording, recording_samples


@pytest.fixture(scope="module")
def frames():
    generator = np.random.default_rng(0)
    blocks = generator.random((9, 6, 8, 3)).astype(np.float32)
    return [SimpleNamespace(rgb=cv2.resize(rgb, (80, 60))) for rgb in blocks]


def changed(frames, change):
    return [SimpleNamespace(rgb=change(frame.rgb).astype(np.float32)) for frame in frames]


def compressed(rgb):
    _, data = cv2.imencode(
        ".jpg", np.rint(255 * rgb).astype(np.uint8), (cv2.IMWRITE_JPEG_QUALITY, 40)
    )
    return cv2.imdecode(data, cv2.IMREAD_COLOR) / 255.0


def test_frames_are_known_at_another_size_and_compressed(frames):
    samples = json.loads(json.dumps(recording_samples(frames, [1, 3, 4, 5, 6, 7])))
    assert [sample["index"] for sample in samples] == [1, 3, 4, 5, 7]
    assert is_same_recording(frames, samples)
    assert is_same_recording(changed(frames, compressed), samples)
    assert is_same_recording(changed(frames, lambda rgb: cv2.resize(rgb, (60, 45))), samples)


def test_other_frames_are_not(frames):
    samples = recording_samples(frames, range(9))
    assert not is_same_recording(changed(frames, lambda rgb: rgb[:, ::-1]), samples)
    assert not is_same_recording(frames[:1], samples)


def test_frames_that_cannot_be_read_do_not_count(frames):
    class Damaged(list):
        def __getitem__(self, index):
            if index == 4:
                raise FormatError("frame 4 is damaged")
            return super().__getitem__(index)

    assert is_same_recording(Damaged(frames), recording_samples(frames, range(9)))


def test_a_run_without_frames_knows_none(frames):
    assert recording_samples(frames, []) == []
    assert is_same_recording(frames, [])
