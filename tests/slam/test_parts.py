"""Parts of a map: what was never joined has a frame, a trajectory and a map of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam_room import FEW, another_place, fed, first_steps

from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.refinement.parts import by_size
from toolkit.slam.result import Loss, loss_before
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


def new_slam(folder=None, max_keyframes=150):
    settings = validated(
        LoopClosureOptions,
        {
            "relocalisation": {"patience": 2},
        },
    )
    mapper = Mapper(FEW, np.random.default_rng(0))
    closer = build_loop_closer(settings, ClosingContext(0, "auto", SemanticMapping(), None))
    allocation = Allocation(AllocationOptions(max_keyframes=max_keyframes), 0)
    atlas = Atlas(mapper.first_submap(), allocation, SubmapStore(folder))
    return Slam(FrontEnd(DenseTracker(), closer), mapper, atlas=atlas)


def later(frame, index):
    """The same view as a frame of another index."""
    return replace(frame, index=index, timestamp_s=index / 30.0)


def sequence(room, returns=False):
    """Four frames of the room, six of another place, of which two are lost, and the room again."""
    shown = [*room.frames[:4], *map(another_place, room.frames[8:14])]
    shown += [room.frames[k] for k in (3, 2, 1)] if returns else []
    return [later(frame, index) for index, frame in enumerate(shown)]


@pytest.fixture(scope="module")
def divided(room):
    """A finished run whose main part is not the first one."""
    slam = new_slam()
    results = fed(slam, [*sequence(room), later(another_place(room.frames[13]), 10)])
    return slam, results, slam.finish()


def test_the_part_of_the_most_frames_is_the_result(divided):
    _, results, final = divided
    assert [result.submap for result in results] == [0] * 4 + [None] * 2 + [1] * 5
    assert final.parts == [(1,), (0,)]
    assert final.frame_indices == [6, 7, 8, 9, 10] and final.frame_submaps == [1] * 5
    assert len(final.trajectory) == len(final.exposures) == len(final.covariances) == 5
    (other,) = final.other_parts
    assert other.submaps == (0,) and other.frames.indices == [0, 1, 2, 3]
    assert len(other.frames.trajectory) == len(other.frames.covariances) == 4
    assert other.loss == Loss(4, final.lost_frames[4])


def test_each_part_has_its_own_frame(divided, room):
    slam, _, final = divided
    for number in (0, 1):
        assert np.array_equal(slam.atlas.T_world_submap(number), np.eye(4))
        assert np.array_equal(final.submaps[number].T_world_submap, np.eye(4))
    assert np.allclose(final.trajectory.T_world_camera[0], np.eye(4), atol=1e-9)
    path = final.other_parts[0].frames.trajectory.T_world_camera
    assert np.abs(path[:, :3, 3] - room.truth.T_world_camera[:4, :3, 3]).max() < 0.01
    # The anchor of a part is certain; that of a common frame would be unknown by metres.
    assert np.sqrt(final.covariances[0].diagonal()[:3]).max() < 0.05


def test_the_maps_of_parts_are_fused_separately(divided):
    slam, _, final = divided
    (other,) = final.other_parts
    assert final.map.numbers == [1] and other.map.numbers == [0]
    for number, one in ((1, final.map), (0, other.map)):
        assert len(one) == len(slam.atlas.submap(number).gaussians) > 0


def test_a_submap_is_refined_with_the_cameras_of_its_part(room, monkeypatch):
    slam = new_slam()
    fed(slam, sequence(room))
    cameras = []
    monkeypatch.setattr(slam.mapper, "refine", lambda submap, T, *_: cameras.append(T))
    slam.finish()
    first, second = cameras
    assert len(first) == len(second) == 4
    for poses in cameras:
        assert np.allclose(poses[0], np.eye(4), atol=1e-6)


def test_a_part_is_seen_in_its_own_frame_during_the_run(room):
    slam = new_slam()
    fed(slam, sequence(room))
    assert not np.allclose(slam.atlas.T_world_submap(1)[:3, 3], 0.0)
    during = slam.result()
    assert during.parts == [(0,), (1,)] and during.other_parts[0].map is None
    np.testing.assert_allclose(during.submaps[1].T_world_submap[:3, 3], np.zeros(3), atol=1e-12)
    first = during.other_parts[0].frames.trajectory.T_world_camera[0]
    assert np.allclose(first, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("cut", [None, 7, 11])
def test_a_verified_place_joins_parts(room, cut, tmp_path):
    """The camera returns to the first part; a resumed run has the same parts."""
    frames = sequence(room, returns=True)
    slam = new_slam(tmp_path)
    fed(slam, frames[:cut])
    if cut is not None:
        state = slam.state()
        slam = new_slam(tmp_path)
        slam.restore(*state)
        fed(slam, frames[cut:])
    assert slam.parts == [(0, 2), (1,)]
    final = slam.finish()
    assert final.frame_indices == [0, 1, 2, 3, 10, 11, 12]
    error_m = final.trajectory.T_world_camera[4:, :3, 3] - room.truth.T_world_camera[3:0:-1, :3, 3]
    assert np.abs(error_m).max() < 0.01
    assert final.other_parts[0].loss.index == 4


def test_a_loop_between_parts_makes_them_one(room):
    slam = new_slam()
    fed(slam, sequence(room))
    assert slam.parts == [(0,), (1,)]
    T = se3.exp(np.array([0.5, 0.0, 0.0, 0.0, 0.3, 0.0]))
    slam._closer._graph.loops.append(slam._closer._parts.loop_noise.edge(0, 1, T, 1e6 * np.eye(6)))
    assert slam.parts == [(0, 1)]
    joined = slam.result()
    assert joined.other_parts == [] and len(joined.frame_indices) == 8


def test_submaps_that_start_while_tracked_are_one_part(room):
    slam = new_slam(max_keyframes=3)
    fed(slam, room.frames)
    assert len(slam.atlas) > 1
    assert slam.parts == [tuple(range(len(slam.atlas)))]
    assert slam.finish().other_parts == []


def test_the_main_part_has_the_most_reliable_frames():
    parts = [(0, 1), (2,), (3,)]
    frames = [0, 1, 2, 2, 2, 3, 3, 3, 3]
    sure = [True, True, True, True, True, True, True, False, False]
    assert by_size(parts, frames, [True] * 9) == [(3,), (2,), (0, 1)]
    assert by_size(parts, frames, sure) == [(2,), (3,), (0, 1)]
    # The frame of a loaded map is that of the world, if any frame was located there.
    assert by_size(parts, frames, sure, saved=1) == [(0, 1), (2,), (3,)]
    assert by_size(parts, frames[2:], sure[2:], saved=1) == [(2,), (3,), (0, 1)]


def test_the_loss_before_a_part_is_the_first_lost_frame():
    lost, doubtful = {5: "dark", 6: "dark", 9: "blurred"}, {3: "unsure", 4: "unsure"}
    assert loss_before(7, lost, doubtful) == Loss(5, "dark")
    assert loss_before(5, {}, doubtful) == Loss(3, "unsure")
    assert loss_before(9, {}, doubtful) is None and loss_before(0, lost, doubtful) is None


@pytest.mark.parametrize(
    ("time_s", "reason"),
    [
        (3 / 30.0, "its time, 0.100 s, is not after that of frame 3"),
        (-5.0, "its time, -5.000 s, is not after that of frame 3"),
        (float("nan"), "its time is not finite"),
    ],
)
def test_a_frame_out_of_order_is_lost_with_the_reason(room, time_s, reason):
    slam = new_slam()
    frames = list(room.frames[:6])
    frames[4] = replace(frames[4], timestamp_s=time_s)
    results = fed(slam, frames)
    assert [result.lost for result in results] == [False] * 4 + [True, False]
    assert results[4].reason == reason and slam.result().lost_frames == {4: reason}
    assert slam.camera_path.unreliable_in_a_row == 0
    assert len(slam.finish().trajectory) == 5


def test_a_frame_that_cannot_be_read_is_lost_with_the_reason(room):
    slam, frames = new_slam(), list(room.frames[:6])
    black = np.zeros_like(frames[3].rgb), np.zeros_like(frames[3].depth_m)
    frames[3] = replace(frames[3], rgb=black[0], depth_m=black[1], fault="3.png is truncated")
    results = fed(slam, frames)
    assert [result.lost for result in results] == [False] * 3 + [True] + [False] * 2
    assert slam.result().lost_frames == {3: "3.png is truncated"}
    assert slam.camera_path.unreliable_in_a_row == 0


def test_a_dropped_frame_out_of_order_has_no_pose(room):
    slam = new_slam()
    fed(slam, room.frames[:3])
    assert slam.drop_frame(replace(room.frames[3], timestamp_s=0.0)).lost
    assert "is not after" in slam.result().lost_frames[3]
    assert len(slam.result().trajectory) == 3


def test_a_clock_that_starts_again_ends_with_lost_frames_not_with_an_error(room):
    """Two recordings in one folder, each with times from zero."""
    slam = new_slam()
    frames = [*room.frames[:5], *(replace(f, index=f.index + 5) for f in room.frames[:5])]
    fed(slam, frames)
    final = slam.finish()
    assert final.frame_indices == list(range(5)) and list(final.lost_frames) == list(range(5, 10))
    assert len(final.parts) == 1
