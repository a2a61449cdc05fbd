"""A lost camera: found again in its submap or another, or a new submap where nothing is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam_room import FEW, blind_frames, fed, first_steps

from toolkit.closing.factory import ClosingContext, build_loop_closer
from toolkit.geometry import se3
from toolkit.mapping.mapper import Mapper
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.settings.loop_closure import LoopClosureSettings
from toolkit.slam import Slam
from toolkit.submaps.allocation import Allocation, AllocationOptions
from toolkit.submaps.atlas import Atlas
from toolkit.tracking.dense import DenseTracker


@pytest.fixture(scope="module")
def room():
    return first_steps(14)


def new_slam(patience=3, most_keyframes=150):
    settings = LoopClosureSettings.model_validate(
        {
            "relocalisation": {"patience": patience},
            "registration": {"coarse": {"matching": {"least_matches": 6}}},
        }
    )
    mapper = Mapper(FEW, np.random.default_rng(0))
    closer = build_loop_closer(settings, ClosingContext(0, "auto", SemanticMapping(), None))
    atlas = Atlas(mapper, Allocation(AllocationOptions(most_keyframes=most_keyframes), 0))
    return Slam(DenseTracker(), mapper, atlas=atlas, closer=closer)


def error_m(slam, room, index):
    place = slam.tracked_indices.index(index)
    truth = room.truth.T_world_camera[index % 100]
    return float(
        np.linalg.norm((se3.inverse(truth) @ slam.trajectory.T_world_camera[place])[:3, 3])
    )


def later(frame, count):
    """The same view, seen again."""
    return replace(frame, index=frame.index + count, timestamp_s=frame.timestamp_s + count)


def test_a_kidnapped_camera_is_found_in_its_submap(room):
    slam = new_slam()
    fed(slam, room.frames)
    slam.tracker.go_on_from(9.0, se3.exp(np.array([3.0, 0, 0, 0, 2.0, 0])))
    result = slam.process_frame(later(room.frames[2], 100))
    assert not result.lost and len(slam.atlas) == 1
    assert error_m(slam, room, 102) < 0.01


def test_found_in_another_submap_a_new_one_begins_there(room):
    slam = new_slam(most_keyframes=3)
    fed(slam, room.frames)
    count = len(slam.atlas)
    assert count > 1
    slam.tracker.go_on_from(9.0, se3.exp(np.array([3.0, 0, 0, 0, 2.0, 0])))
    result = slam.process_frame(later(room.frames[0], 100))
    assert not result.lost
    if len(slam.atlas) > count:
        assert slam.mapper.keyframes[0].index == 100
    assert error_m(slam, room, 100) < 0.015


def test_darkness_is_reported_and_survived(room):
    slam = new_slam(patience=50)
    fed(slam, room.frames[:8])
    results = fed(slam, blind_frames(room.frames[8:10]))
    assert all(result.lost for result in results)
    assert not slam.process_frame(room.frames[10]).lost
    assert slam.lost_frames == [8, 9]
    assert error_m(slam, room, 10) < 0.02


def test_darkness_ends_no_patience_and_widens_no_limit(room):
    slam = new_slam(patience=2)
    fed(slam, room.frames[:8])
    fit = slam.tracker.state()["scales"]
    fed(slam, blind_frames(room.frames[8:13]))
    assert np.array_equal(slam.tracker.state()["scales"], fit)
    again = replace(room.frames[7], index=13, timestamp_s=room.frames[13].timestamp_s)
    assert not slam.process_frame(again).lost and len(slam.atlas) == 1


def test_where_nothing_is_found_a_new_submap_begins(room):
    slam = new_slam(patience=2)
    fed(slam, room.frames[:4])
    elsewhere = [
        replace(f, rgb=np.ascontiguousarray(f.rgb[::-1, ::-1, ::-1]), depth_m=f.depth_m[::-1] + 2.0)
        for f in (later(frame, 100) for frame in room.frames[8:13])
    ]
    results = fed(slam, elsewhere)
    assert results[0].lost, "it is not taken for the place that is known"
    assert len(slam.atlas) == 2 and not results[-1].lost
    assert slam.mapper.keyframes[0].index in slam.keyframe_indices


def test_a_lost_run_goes_on_from_a_checkpoint(room):
    def ended(cut):
        slam = new_slam(patience=2)
        frames = [*room.frames[:5], *blind_frames(room.frames[5:7]), *room.frames[7:10]]
        fed(slam, frames[:cut])
        arrays, values = slam.state()
        other = new_slam(patience=2)
        other.restore(arrays, values)
        fed(other, frames[cut:])
        return other

    a, b = ended(6), ended(8)
    assert a.lost_frames == b.lost_frames
    assert np.array_equal(a.trajectory.T_world_camera, b.trajectory.T_world_camera)
