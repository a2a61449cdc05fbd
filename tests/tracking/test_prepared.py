"""Frames made ready ahead of their turn: the same answers, and nothing kept for long."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from tracked_room import Room

from toolkit.base.frame import Frame
from toolkit.slam.tracking import prepared as module
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.prepared import PreparedFrames, prepared
from toolkit.splatting.gaussians.cloud import GaussianCloud

CPU = torch.device("cpu")


def test_a_frame_is_made_ready_once(room, monkeypatch):
    ahead = PreparedFrames(levels=3)
    ahead.prepare(room.frames[1], CPU)
    monkeypatch.setattr(module, "prepared", lambda *_: pytest.fail("made ready again"))
    first, second = ahead.of(room.frames[1], CPU), ahead.of(room.frames[1], CPU)
    assert first is second and len(first.levels) == 3


def test_a_frame_that_is_asked_for_again_is_not_made_ready_again(room, monkeypatch):
    ahead = PreparedFrames(levels=2)
    first = ahead.of(room.frames[1], CPU)
    monkeypatch.setattr(module, "prepared", lambda *_: pytest.fail("made ready again"))
    assert ahead.of(room.frames[1], CPU) is first


def test_labels_added_since_are_those_of_the_frame(room):
    ahead = PreparedFrames(levels=2)
    first = ahead.of(room.frames[1], CPU)
    labels = np.ones_like(room.frames[1].depth_m, dtype=np.int32)
    labelled = replace(room.frames[1], labels=labels)
    held = ahead.of(labelled, CPU)
    assert held.frame is labelled and held.levels is first.levels


def test_other_images_of_the_same_number_are_not_mistaken(room):
    ahead = PreparedFrames(levels=2)
    ahead.prepare(room.frames[1], CPU)
    darker = replace(room.frames[1], rgb=room.frames[1].rgb * np.float32(0.5))
    found = ahead.of(darker, CPU)
    assert found.frame is darker
    assert torch.allclose(found.levels[0].intensity, prepared(darker, 1, CPU).levels[0].intensity)


def test_frames_before_the_one_asked_for_are_let_go(room):
    ahead = PreparedFrames(levels=1)
    for frame in room.frames[:3]:
        ahead.prepare(frame, CPU)
    ahead.of(room.frames[2], CPU)
    assert [p.frame.index for p in ahead._cache] == [2]


def test_frames_nobody_asks_for_do_not_pile_up(room):
    ahead = PreparedFrames(levels=1)
    for index in range(50):
        ahead.prepare(replace(room.frames[0], index=index), CPU)
    assert [p.frame.index for p in ahead._cache] == list(range(50 - module._MAX_FRAMES, 50))


def test_depth_is_summed_up(room):
    frame = room.frames[0]
    ready = prepared(frame, 1, CPU)
    assert ready.measured == int((frame.depth_m > 0).sum())
    assert ready.median_depth_m == pytest.approx(
        float(np.median(frame.depth_m[frame.depth_m > 0])), 0.05
    )
    blind = replace(frame, depth_m=np.zeros_like(frame.depth_m))
    assert (prepared(blind, 1, CPU).median_depth_m, prepared(blind, 1, CPU).measured) == (1.0, 0)


def test_wide_images_are_halved(room, monkeypatch):
    frame = room.frames[0]
    camera = frame.camera
    assert prepared(frame, 2, CPU, max_width=32).levels[0].camera == camera, "too few pixels"
    monkeypatch.setattr(module, "MIN_PIXELS", camera.width * camera.height // 4)
    ready = prepared(frame, 2, CPU, max_width=camera.width - 1)
    assert ready.frame is frame
    assert [level.camera for level in ready.levels] == [camera.halved(), camera.halved().halved()]
    assert ready.measured == int((ready.levels[0].depth_m > 0).sum())
    assert prepared(frame, 2, CPU, max_width=camera.width).levels[0].camera == camera


def tracked(room: Room, gaussians: GaussianCloud, frames: list[Frame], ahead: bool) -> list[bytes]:
    """Poses of frames, made ready by another thread meanwhile or not."""
    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    reader = threading.Thread(target=lambda: [tracker._prepared.prepare(f, CPU) for f in frames])
    if ahead:
        reader.start()
    poses = [tracker.track(frame, gaussians).T_map_camera.tobytes() for frame in frames]
    if ahead:
        reader.join()
    return poses


def test_results_are_the_same_to_the_bit(room, gaussians):
    frames = room.frames[1:4]
    assert tracked(room, gaussians, frames, True) == tracked(room, gaussians, frames, False)


def test_on_a_cpu_nothing_is_done_ahead(room):
    tracker = DenseTracker()
    tracker.prepare(room.frames[1], CPU)
    assert tracker._prepared._cache == []
