"""Frames that show nothing: the map starts after them, and they are never mapped."""

from dataclasses import replace

import numpy as np
import pytest
from slam_room import first_steps, new_slam

from toolkit.tracking.health import is_black


@pytest.fixture(scope="module")
def frames():
    return first_steps(10).frames


def noise(frame):
    grain = np.random.default_rng(0).uniform(0.0, 0.04, frame.rgb.shape).astype(np.float32)
    return replace(frame, rgb=grain)


def test_a_dark_room_is_not_black(frames):
    assert is_black(replace(frames[0], rgb=np.zeros_like(frames[0].rgb)))
    assert is_black(noise(frames[0]))
    assert not is_black(replace(frames[0], rgb=0.15 * frames[0].rgb))


@pytest.mark.parametrize("with_depth", [True, False])
def test_the_map_starts_at_the_first_frame_that_shows_something(frames, with_depth):
    black = [noise(frame) for frame in frames[:3]]
    if not with_depth:
        black = [replace(frame, depth_m=np.zeros_like(frame.depth_m)) for frame in black]
    slam = new_slam()
    results = [slam.process_frame(frame) for frame in [*black, *frames[3:]]]
    assert [result.lost for result in results] == [True] * 3 + [False] * 7
    assert all("black" in result.reason for result in results[:3])
    assert slam.result().keyframe_indices[0] == 3


def test_a_black_frame_among_others_is_not_mapped(frames):
    slam = new_slam()
    for frame in frames:
        slam.process_frame(noise(frame) if frame.index == 5 else frame)
    assert 5 not in slam.result().keyframe_indices
