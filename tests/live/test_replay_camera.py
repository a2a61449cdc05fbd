"""A dataset as a camera: its frames come at their own times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets.registry import open_dataset
from toolkit.runs.live.replay import ReplayCamera


@pytest.mark.parametrize(("fps", "period_s"), [(200.0, 0.005), (None, 1 / 30)])
def test_frames_come_at_their_times_and_not_before(tiny_recording: Path, fps, period_s):
    dataset = open_dataset("folder", tiny_recording, max_frames=4)
    camera = ReplayCamera(dataset, fps)
    assert camera.start() == dataset.camera
    captured = list(camera.frames())
    assert [c.frame.index for c in captured] == [0, 1, 2, 3]
    np.testing.assert_array_equal(captured[2].frame.rgb, dataset[2].rgb)
    since_s = np.array([c.captured_s - captured[0].captured_s for c in captured])
    # A busy machine may be late, never early.
    assert (since_s >= period_s * np.arange(4) - 0.006).all()


def test_a_stopped_replay_ends(tiny_recording: Path):
    camera = ReplayCamera(open_dataset("folder", tiny_recording), fps=0.01)
    frames = camera.frames()
    assert next(frames).frame.index == 0
    camera.stop()
    assert list(frames) == []
