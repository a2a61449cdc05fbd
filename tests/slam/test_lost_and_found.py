"""A lost camera: found again in its submap or another, or a new submap where nothing is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam_room import FEW, another_place, blind_frames, fed, fingerprint, first_steps

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.allocation import Allocation
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.options import AllocationOptions
from toolkit.slam.submaps.store import SubmapStore
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker

pytestmark = pytest.mark.usefixtures("few_matches")


@pytest.fixture(scope="module")
def room():
    return first_steps(14)


def new_slam(patience=3, max_keyframes=150, folder=None):
    settings = validated(
        LoopClosureOptions,
        {
            "relocalisation": {"patience": patience},
        },
    )
    mapper = Mapper(FEW, np.random.default_rng(0))
    closer = build_loop_closer(settings, ClosingContext(0, "auto", SemanticMapping(), None))
    allocation = Allocation(AllocationOptions(max_keyframes=max_keyframes), 0)
    atlas = Atlas(mapper.first_submap(), allocation, SubmapStore(folder))
    return Slam(FrontEnd(DenseTracker(), closer), mapper, atlas=atlas)


def error_m(slam, room, index):
    result = slam.result()
    T_world_camera = result.trajectory.T_world_camera[result.frame_indices.index(index)]
    truth = room.truth.T_world_camera[index % 100]
    return float(np.linalg.norm((se3.inverse(truth) @ T_world_camera)[:3, 3]))


def later(frame, count):
    """The same view, seen again."""
    return replace(frame, index=frame.index + count, timestamp_s=frame.timestamp_s + count)


def test_a_kidnapped_camera_is_found_in_its_submap(room):
    slam = new_slam()
    fed(slam, room.frames)
    slam.tracker.continue_from(9.0, se3.exp(np.array([3.0, 0, 0, 0, 2.0, 0])))
    result = slam.process_frame(later(room.frames[2], 100))
    assert not result.lost and len(slam.atlas) == 1
    assert error_m(slam, room, 102) < 0.01


def test_found_in_another_submap_a_new_one_begins_there(room, monkeypatch):
    slam = new_slam(max_keyframes=3)
    # Of itself, the tracker would find the frame in the active submap, which overlaps.
    monkeypatch.setattr(slam.tracker, "_further_starts", lambda *_: iter(()))
    fed(slam, room.frames)
    count = len(slam.atlas)
    assert count > 1
    slam.tracker.continue_from(9.0, se3.exp(np.array([3.0, 0, 0, 0, 2.0, 0])))
    result = slam.process_frame(later(room.frames[0], 100))
    assert len(slam.atlas) == count + 1
    assert [k.index for k in slam.atlas.keyframes] == [100]
    assert [(loop.first, loop.second) for loop in slam.result().loops] == [(0, count)]
    assert not result.tracking.lost and np.array_equal(result.T_map_camera, np.eye(4))
    assert error_m(slam, room, 100) < 0.015


def test_darkness_is_reported_and_survived(room):
    slam = new_slam(patience=50)
    fed(slam, room.frames[:8])
    results = fed(slam, blind_frames(room.frames[8:10]))
    assert all(result.lost for result in results)
    assert not slam.process_frame(room.frames[10]).lost
    assert list(slam.result().lost_frames) == [8, 9]
    assert error_m(slam, room, 10) < 0.02


def test_darkness_ends_no_patience_and_widens_no_limit(room):
    slam = new_slam(patience=2)
    fed(slam, room.frames[:8])
    fit = slam.tracker.state()["scales"]
    fed(slam, blind_frames(room.frames[8:13]))
    assert np.array_equal(slam.tracker.state()["scales"], fit)
    again = replace(room.frames[7], index=13, timestamp_s=room.frames[13].timestamp_s)
    assert not slam.process_frame(again).lost and len(slam.atlas) == 1


def views_of_another_place(frames):
    return [another_place(later(frame, 100)) for frame in frames]


def test_where_nothing_is_found_a_new_submap_begins(room):
    slam = new_slam(patience=2)
    fed(slam, room.frames[:4])
    results = fed(slam, views_of_another_place(room.frames[8:13]))
    assert [result.lost for result in results] == [True, True, False, False, False]
    assert len(slam.atlas) == 2
    assert slam.atlas.keyframes[0].index == results[2].index
    assert results[2].tracking.lost and results[2].tracking.reason, "nothing located this frame"
    final = slam.result()
    (other,) = final.other_parts
    assert other.frames.exposures[0] == IDENTITY


@pytest.mark.parametrize("cut", [5, 6, 7])
def test_a_run_resumed_while_lost_equals_an_uninterrupted_run(room, cut, tmp_path):
    """Cut after one and two of the lost frames, and after the new submap has started."""
    frames = [*room.frames[:4], *views_of_another_place(room.frames[8:13])]
    whole, begun = new_slam(patience=2), new_slam(patience=2, folder=tmp_path)
    fed(whole, frames)
    fed(begun, frames[:cut])
    resumed = new_slam(patience=2, folder=tmp_path)
    resumed.restore(*begun.state())
    fed(resumed, frames[cut:])
    assert len(whole.atlas) == 2
    assert fingerprint(resumed) == fingerprint(whole)
