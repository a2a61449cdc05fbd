"""A map cannot begin with a frame that shows nothing."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from tracked_room import Room, blind_frame, dead_sensor_frame

from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.first_order_tracker import FirstOrderTracker
from toolkit.slam.tracking.given import GivenPoses
from toolkit.slam.tracking.options import FirstOrderOptions
from toolkit.slam.tracking.tracker import Tracker


def without_numbers(like: Frame) -> Frame:
    """As some drivers mark pixels without depth."""
    return replace(like, depth_m=np.full_like(like.depth_m, np.nan))


def at_infinity(like: Frame) -> Frame:
    return replace(like, depth_m=np.full_like(like.depth_m, np.inf))


def of_eight_bits(like: Frame) -> Frame:
    """As images are before they are divided by 255."""
    return replace(like, rgb=255 * np.ones_like(like.rgb))


FAULTS = [
    (blind_frame, "only 0 pixels have depth"),
    (without_numbers, "only 0 pixels have depth"),
    (at_infinity, "only 0 pixels have depth"),
    (dead_sensor_frame, "its colour image contains values that are not finite"),
    (of_eight_bits, "its colours reach 255, but must be between 0 and 1"),
]


@pytest.fixture(params=["dense", "first-order", "given"])
def tracker(request: pytest.FixtureRequest, room: Room) -> Tracker:
    if request.param == "given":
        times = np.array([frame.timestamp_s for frame in room.frames])
        return GivenPoses(Trajectory(times, room.T_map_camera))
    if request.param == "first-order":
        return FirstOrderTracker(FirstOrderOptions(iterations=2))
    return DenseTracker()


@pytest.mark.parametrize(("make", "fault"), FAULTS)
def test_such_a_frame_is_refused_in_one_line(room, tracker, caplog, make, fault):
    before = {name: array.copy() for name, array in tracker.state().items()}
    with caplog.at_level(logging.WARNING, "toolkit"):
        assert tracker.first_pose(make(room.frames[0])) is None
    assert [r.getMessage() for r in caplog.records] == [f"Frame 0 cannot start the map: {fault}."]
    after = tracker.state()
    assert all(np.array_equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("make", [make for make, _ in FAULTS])
def test_the_next_frame_starts_the_map(room, tracker, make):
    slam = Slam(FrontEnd(tracker), Mapper(MapperOptions(first_iterations=2, iterations=1)))
    assert slam.process_frame(make(room.frames[0])).lost
    assert len(slam.atlas.gaussians) == 0
    assert not slam.process_frame(room.frames[1]).lost
    assert [k.index for k in slam.atlas.keyframes] == [1]
    assert list(slam.result().lost_frames) == [0]
    assert len(slam.atlas.gaussians) > 1000
