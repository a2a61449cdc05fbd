"""Frames that show nothing: the map starts after them, and they are never mapped."""

from dataclasses import replace

import numpy as np
import pytest
from slam_room import FEW, first_steps, new_slam

from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.system import Slam
from toolkit.slam.tracking.given import GivenPoses
from toolkit.slam.tracking.health import is_blank


@pytest.fixture(scope="module")
def room():
    return first_steps(10)


@pytest.fixture
def frames(room):
    return room.frames


def noise(frame):
    grain = np.random.default_rng(0).uniform(0.0, 0.04, frame.rgb.shape).astype(np.float32)
    return replace(frame, rgb=grain)


def overexposed(frame):
    return replace(frame, rgb=1.0 - noise(frame).rgb)


def test_a_dark_room_is_not_blank(frames):
    assert is_blank(replace(frames[0], rgb=np.zeros_like(frames[0].rgb)))
    assert is_blank(noise(frames[0]))
    assert not is_blank(replace(frames[0], rgb=0.15 * frames[0].rgb))


def test_saturated_images_are_blank(frames):
    magenta = np.broadcast_to(np.float32([1.0, 0.0, 1.0]), frames[0].rgb.shape)
    assert is_blank(replace(frames[0], rgb=magenta))
    assert is_blank(overexposed(frames[0]))
    assert not is_blank(replace(frames[0], rgb=1.0 - 0.15 * frames[0].rgb))
    # Black and white, but not the same everywhere.
    assert not is_blank(replace(frames[0], rgb=frames[0].rgb.round()))


@pytest.mark.parametrize("with_depth", [True, False])
def test_the_map_starts_at_the_first_frame_that_shows_something(frames, with_depth):
    black = [noise(frame) for frame in frames[:3]]
    if not with_depth:
        black = [replace(frame, depth_m=np.zeros_like(frame.depth_m)) for frame in black]
    slam = new_slam()
    results = [slam.process_frame(frame) for frame in [*black, *frames[3:]]]
    assert [result.lost for result in results] == [True] * 3 + [False] * 7
    assert all("blank" in result.reason for result in results[:3])
    assert slam.result().keyframe_indices[0] == 3


@pytest.mark.parametrize("blank", [noise, overexposed])
def test_a_blank_frame_among_others_is_not_mapped(room, blank):
    slam = Slam(FrontEnd(GivenPoses(room.truth)), Mapper(FEW))
    for frame in room.frames[:6]:
        slam.process_frame(blank(frame) if frame.index == 4 else frame)
    assert slam.result().keyframe_indices == [0, 5]  # 4, if it showed anything
