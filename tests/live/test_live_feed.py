"""The frames of a camera as SLAM gets them: numbers, sizes, storage, and what ends them."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scripted_camera import ScriptedCamera, room_frames

from toolkit.base.errors import CameraError, RunFolderError
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.resize import ImageGrid
from toolkit.runs.live.feed import FeedOptions, LiveFeed
from toolkit.runs.live.frame_writer import FrameWriter

FRAMES = room_frames(4)


def feed_of(camera: ScriptedCamera, stop: threading.Event | None = None, **parts) -> LiveFeed:
    options = parts.pop("options", FeedOptions(capacity=10, timeout_s=20.0))
    return LiveFeed(camera, options, stop or threading.Event(), **parts)


def test_all_frames_come_in_order_and_the_camera_is_stopped():
    camera = ScriptedCamera(FRAMES)
    feed = feed_of(camera)
    assert [frame.index for frame in feed] == [0, 1, 2, 3]
    assert feed.failure is None
    assert camera.stopped.is_set()


def test_frames_of_a_camera_are_numbered_without_dropped_ones():
    step = threading.Semaphore(0)
    feed = feed_of(ScriptedCamera(FRAMES, taken=step), options=FeedOptions(1, 20.0))
    frames = iter(feed)
    first = next(frames)
    for _ in range(4):  # the others arrive while the first one is processed
        step.release()
    second = next(frames)
    assert (first.index, second.index) == (0, 1)
    assert second.timestamp_s == FRAMES[3].timestamp_s
    assert [frame.index for frame in feed.delivery.dropped] == [1, 2]


@pytest.mark.parametrize(
    "error", [CameraError("scripted failed: unplugged"), RuntimeError("unplugged")]
)
def test_an_error_of_the_driver_ends_the_feed_after_the_last_frame(error: Exception):
    feed = feed_of(ScriptedCamera(FRAMES, error=error))
    assert len(list(feed)) == 4
    assert isinstance(feed.failure, CameraError)
    assert str(feed.failure) == "scripted failed: unplugged"


def test_a_camera_that_sends_nothing_counts_as_disconnected():
    camera = ScriptedCamera(FRAMES, stalls=True)
    feed = feed_of(camera, options=FeedOptions(10, 0.1))
    assert len(list(feed)) == 4
    assert isinstance(feed.failure, CameraError)
    assert "no frame from scripted for 0.1 s" in str(feed.failure)
    assert camera.stopped.is_set()


def test_a_feed_that_is_stopped_ends_without_failure():
    stop = threading.Event()
    feed = feed_of(ScriptedCamera(FRAMES, stalls=True), stop)
    frames = iter(feed)
    assert next(frames).index == 0
    stop.set()
    assert list(frames) == []
    assert feed.failure is None


def test_idle_work_is_done_while_no_frame_waits():
    calls = []
    feed = feed_of(ScriptedCamera(FRAMES, stalls=True), options=FeedOptions(10, 0.1))
    feed.idle = lambda: bool(calls.append(1)) or len(calls) < 3
    list(feed)
    assert len(calls) >= 3


def test_frames_are_resampled_to_the_size_of_the_run():
    grid = ImageGrid(FRAMES[0].camera, (32, 24))
    frame = next(iter(feed_of(ScriptedCamera(FRAMES), grid=grid)))
    assert frame.camera.size == (32, 24)
    assert frame.rgb.shape == (24, 32, 3)


def test_stored_frames_are_a_dataset_with_the_same_images_and_times(tmp_path: Path):
    folder = tmp_path / "recording"
    writer = FrameWriter(folder, FRAMES[0].camera, 5000.0, 30.0)
    # Times of a camera are neither equally spaced nor from 0.
    times_s = [1600000000.125, 1600000000.5, 1600000001.75, 1600000001.8]
    shown = [replace(f, timestamp_s=t) for f, t in zip(FRAMES, times_s, strict=True)]
    list(feed_of(ScriptedCamera(shown), writer=writer))
    writer.close()
    dataset = open_dataset("folder", folder)
    assert dataset.camera == FRAMES[0].camera
    assert dataset.timestamps_s.tolist() == times_s
    for stored, frame in zip(dataset, shown, strict=True):
        assert np.abs(stored.rgb - frame.rgb).max() <= 0.5 / 255 + 1e-6
        assert np.abs(stored.depth_m - frame.depth_m).max() <= 0.5 / 5000 + 1e-6


def test_a_disk_that_fails_ends_the_feed_instead_of_losing_frames(tmp_path: Path):
    writer = FrameWriter(tmp_path / "recording", FRAMES[0].camera, 5000.0, 30.0)
    (tmp_path / "recording" / "timestamps.txt").mkdir()
    feed = feed_of(ScriptedCamera(FRAMES * 5, stalls=True), writer=writer)
    list(feed)
    assert isinstance(feed.failure, RunFolderError)
    assert "cannot write" in str(feed.failure)
    writer.remove()
    assert not (tmp_path / "recording").exists()
