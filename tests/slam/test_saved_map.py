"""A run that begins in the map of an earlier one: found, extended, and never moved."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from slam_room import FEW, another_place, blind_frames, fed, fingerprint, first_steps

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry import se3
from toolkit.base.options import validated
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops import relocalisation
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import KeyframePolicy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.allocation import Allocation
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.options import AllocationOptions
from toolkit.slam.submaps.store import SubmapStore
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.splatting.gaussians.cloud import LOW_PASS_3DGS

pytestmark = pytest.mark.usefixtures("few_matches")


@pytest.fixture(scope="module")
def room():
    return first_steps(12)


def new_slam(patience=3, max_keyframes=150, folder=None, **loops):
    settings = validated(
        LoopClosureOptions,
        {
            "relocalisation": {"patience": patience},
            **loops,
        },
    )
    mapper = Mapper(replace(FEW, keyframes=KeyframePolicy(interval=2)), np.random.default_rng(0))
    closer = build_loop_closer(settings, ClosingContext(0, "auto", SemanticMapping(), None))
    allocation = Allocation(AllocationOptions(max_keyframes=max_keyframes), 0)
    atlas = Atlas(mapper.first_submap(), allocation, SubmapStore(folder))
    return Slam(FrontEnd(DenseTracker(), closer), mapper, atlas=atlas)


@pytest.fixture(scope="module")
def saved(room):
    """Two submaps of the first half of the path, under the numbers that a saved map has."""
    slam = new_slam(max_keyframes=3)
    fed(slam, room.frames[:8])
    slam.finish()
    assert len(slam.atlas) > 1
    return [slam.atlas.submap(n).renumbered(n, -100) for n in range(len(slam.atlas))]


def copies(saved):
    return [replace(s, gaussians=s.gaussians.select(s.optimiser.steps >= 0)) for s in saved]


def back(room):
    """The path from its end to its beginning, as a second sequence."""
    return [
        replace(f, index=k, timestamp_s=k / 30.0) for k, f in enumerate(reversed(room.frames[4:]))
    ]


def errors_m(slam, room):
    truth = room.truth.T_world_camera[::-1]
    result = slam.result()
    poses = zip(result.frame_indices, result.trajectory.T_world_camera, strict=True)
    return [np.linalg.norm((se3.inverse(truth[index]) @ T)[:3, 3]) for index, T in poses]


def begun(saved, **options):
    slam = new_slam(**options)
    slam.load_map(copies(saved))
    return slam


def test_the_camera_is_found_and_the_world_is_the_saved_ones(room, saved):
    slam = begun(saved)
    results = fed(slam, back(room))
    assert not results[0].lost and results[0].mapping is None
    assert slam.atlas.active == len(saved) and slam.atlas.saved == len(saved)
    assert max(errors_m(slam, room)) < 0.03
    assert not slam.atlas.submap(0).gaussians.centred_colours, "the saved map was refined"
    assert slam.atlas.gaussians.centred_colours
    assert min(slam.result().keyframe_indices) == 0, "keyframes of the saved map are not its own"


def test_the_saved_map_is_unchanged_and_part_of_the_result(room, saved):
    slam = new_slam()
    # As in a splat file of another tool.
    slam.load_map(
        [replace(s, gaussians=replace(s.gaussians, low_pass=LOW_PASS_3DGS)) for s in copies(saved)]
    )
    fed(slam, back(room))
    slam.finish()
    for old in saved:
        now = slam.atlas.submap(old.number)
        assert np.array_equal(now.T_world_submap, old.T_world_submap)
        assert np.array_equal(now.gaussians.means, old.gaussians.means)
    fused = slam.result().map
    assert fused.exposures[0] == IDENTITY
    assert {0, len(saved)} <= set(fused.submap.tolist())
    # New ellipsoids are optimised with the filter that all are rendered with.
    parts = [slam.atlas.submap(number).gaussians for number in fused.numbers]
    assert all(part.ellipsoids is not None for part in parts)
    assert {part.low_pass for part in parts} == {LOW_PASS_3DGS}


def test_frames_are_lost_until_one_is_found(room, saved):
    slam = begun(saved, patience=50)
    frames = back(room)
    results = fed(slam, [*blind_frames(frames[:2]), *frames[2:5]])
    assert [r.lost for r in results] == [True, True, False, False, False]
    assert "loaded map" in results[0].tracking.reason
    assert max(errors_m(slam, room)) < 0.03


def test_a_held_out_frame_begins_nothing(room, saved):
    slam = begun(saved)
    frame = back(room)[0]
    assert slam.process_frame(frame, may_map=False).lost and not slam.atlas.has_active_submap


def test_where_nothing_is_found_a_submap_of_its_own_begins(room, saved):
    slam = begun(saved, patience=2)
    results = fed(slam, map(another_place, back(room)[:5]))
    assert [r.lost for r in results[:2]] == [True, True] and not results[-1].lost
    assert len(slam.atlas) == len(saved) + 1
    final = slam.finish()
    # The loaded map is no part of the result: where it lies is unknown.
    own = len(saved)
    assert final.parts == [(own,), tuple(range(own))] and final.other_parts == []
    assert final.map.numbers == [own]
    assert np.array_equal(final.submaps[own].T_world_submap, np.eye(4))


CUTS = (0, 1, 4)


@pytest.fixture(scope="module")
def interrupted(room, saved, tmp_path_factory):
    """Six frames, states and folders where they are cut, and what they lead to without a cut."""
    root = tmp_path_factory.mktemp("interrupted")
    frames = back(room)[:6]
    frames[:2] = blind_frames(frames[:2])
    slam, states = begun(saved, patience=50, folder=root / "whole"), {}
    for index, frame in enumerate(frames):
        if index in CUTS:
            arrays, values = slam.state()
            folder = shutil.copytree(root / "whole", root / f"{index}")
            states[index] = arrays, json.loads(json.dumps(values)), folder
        fed(slam, [frame])
    before = fingerprint(slam)
    return frames, states, before, slam.finish().gaussians.means


@pytest.mark.parametrize("cut", CUTS)
def test_it_goes_on_from_a_checkpoint_to_the_same_bits(interrupted, saved, cut):
    frames, states, before, means = interrupted
    arrays, values, folder = states[cut]
    slam = new_slam(patience=50, folder=folder)
    slam.restore(arrays, values)
    assert slam.atlas.saved == len(saved) and slam.atlas.has_active_submap == (cut == 4)
    fed(slam, frames[cut:])
    assert fingerprint(slam) == before
    assert np.array_equal(slam.finish().gaussians.means, means)


def test_a_submap_of_its_own_is_joined_by_a_loop(room, saved, monkeypatch):
    monkeypatch.setattr(relocalisation, "_MIN_VISIBLE", 1.0)  # nothing is ever found
    slam = begun(
        saved,
        relocalisation={"patience": 1},
        candidates={"search_every": 1, "distance": 0.5},
    )
    fed(slam, back(room))
    assert max(errors_m(slam, room)) > 0.1, "it began at a guess"
    slam.finish()
    assert max(errors_m(slam, room)) < 0.04
    assert np.array_equal(slam.atlas.T_world_submap(1), saved[1].T_world_submap)
