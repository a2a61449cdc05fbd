"""Places seen again: the camera continues in the submap that shows them."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from slam_room import FEW, fed, fingerprint, first_steps

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.noise import OdometryNoise
from toolkit.slam import submap_changes
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.odometry import SubmapOdometry
from toolkit.slam.loops.closing.options import ClosingOptions, LoopClosureOptions
from toolkit.slam.mapping import keyframes
from toolkit.slam.mapping.boundary import start_next
from toolkit.slam.mapping.final_optimisation import step_count
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import KeyframePolicy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.allocation import Allocation
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.options import AllocationOptions
from toolkit.slam.submaps.store import SubmapStore
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker

pytestmark = pytest.mark.usefixtures("few_matches")
COUNT = 24


@dataclass
class AtlasOfThree:
    active: int

    def __len__(self):
        return 3


def following(frames, first):
    """Frames as the next ones of a sequence."""
    return [replace(f, index=i, timestamp_s=i / 30.0) for i, f in enumerate(frames, first)]


@pytest.fixture(scope="module")
def there_and_back():
    """24 frames of a room, and the same backwards."""
    room = first_steps(COUNT)
    shown = [*range(COUNT), *range(COUNT - 2, -1, -1)]
    frames = following([room.frames[k] for k in shown], 0)
    return frames, room.truth.T_world_camera[shown]


@pytest.fixture(autouse=True)
def short_visits(monkeypatch):
    """All but the three newest keyframes are of an earlier visit."""
    for module in (keyframes, submap_changes):
        monkeypatch.setattr(module, "RECENT", 3)


def new_slam(folder=None, revisit=0.05, closing=None):
    options = replace(FEW, keyframes=KeyframePolicy(interval=2, revisit=revisit))
    mapper = Mapper(options, np.random.default_rng(0))
    context = ClosingContext(0, "auto", SemanticMapping(), None)
    closing = closing or ClosingOptions()
    closer = build_loop_closer(LoopClosureOptions(closing=closing), context)
    allocation = Allocation(AllocationOptions(min_keyframes=3, max_keyframes=5), 0)
    atlas = Atlas(mapper.first_submap(), allocation, SubmapStore(folder, 0.0))
    return Slam(FrontEnd(DenseTracker(), closer), mapper, atlas=atlas)


@pytest.fixture(scope="module")
def walked(there_and_back, tmp_path_factory):
    """A system that was fed the whole way, what became of each frame, and its folder. Read only."""
    folder = tmp_path_factory.mktemp("walked")
    with pytest.MonkeyPatch.context() as patch:
        for module in (keyframes, submap_changes):
            patch.setattr(module, "RECENT", 3)
        slam = new_slam(folder)
        return slam, fed(slam, there_and_back[0]), folder


def restored(walked, folder):
    again = new_slam(shutil.copytree(walked[2], folder))
    again.restore(*walked[0].state())
    return again


@pytest.fixture
def slam(walked, tmp_path):
    """A system that was fed the whole way."""
    return restored(walked, tmp_path / "slam")


@pytest.fixture(scope="module")
def returned(walked, tmp_path_factory):
    slam = restored(walked, tmp_path_factory.mktemp("returned") / "slam")
    return slam, walked[1], slam.atlas.active, slam.finish()


def test_the_way_back_goes_through_the_submaps_of_the_way_there(returned, there_and_back):
    _, results, entered, final = returned
    there, back = results[: COUNT - 1], results[COUNT:]
    assert entered == 0 and [r.submap for r in back] == sorted(
        (r.submap for r in back), reverse=True
    )
    # One may start before the newest keyframes are those of an earlier visit.
    assert len(final.submaps) <= results[COUNT - 1].submap + 2
    assert sum(r.keyframe for r in back) < 0.5 * sum(r.keyframe for r in there)
    errors = final.trajectory.T_world_camera[:, :3, 3] - there_and_back[1][:, :3, 3]
    assert np.linalg.norm(errors, axis=1).max() < 0.02


def test_results_agree_with_the_path(returned):
    _, results, _, final = returned
    found = np.array([result.T_world_camera for result in results])
    assert np.abs(found - final.trajectory.T_world_camera)[:, :3, 3].max() < 0.01
    assert final.frame_submaps == [result.submap for result in results]


def test_without_the_rule_every_visit_is_mapped(there_and_back, returned):
    slam = new_slam(revisit=0.0)
    fed(slam, there_and_back[0])
    assert len(slam.atlas) > len(returned[3].submaps)


def test_a_killed_run_continues_in_the_submap_that_it_had_entered(there_and_back, walked, tmp_path):
    frames, _ = there_and_back
    whole, results, _ = walked
    entered = next(
        i for i in range(COUNT, len(frames)) if results[i].submap < results[i - 1].submap
    )

    slam = new_slam(tmp_path / "killed")
    fed(slam, frames[: entered + 1])
    assert slam.atlas.visited > 0
    again = new_slam(tmp_path / "killed")
    again.restore(*slam.state())
    fed(again, frames[entered + 1 :])
    assert fingerprint(again) == fingerprint(whole)


def test_a_new_submap_after_the_way_back_is_linked_to_the_newest_one(slam):
    """The odometry stays a chain: from the newest submap back to where the new one starts."""
    newest = len(slam.atlas) - 1
    assert newest > 1 and slam.atlas.active == 0
    closer = slam._closer
    way = closer._graph.odometry.ways_back[0]
    assert (way.first, way.second) == (newest, 0)
    expected = np.linalg.inv(slam.atlas.T_world_submap(newest)) @ slam.atlas.T_world_submap(0)
    assert np.abs(way.T_first_second - expected).max() < 0.02
    direct = closer._parts.noise.covariance(1e9 * np.eye(6), 0.0, 0.0)
    assert np.trace(way.covariance) > 2 * np.trace(direct), "it drifted on the way"


def test_the_link_after_the_way_back_is_what_was_measured(slam):
    """Loops may have moved the anchors, wrongly: odometry does not contain it."""
    atlas, closer = slam.atlas, slam._closer
    newest = len(atlas) - 1
    expected = closer._graph.odometry.ways_back[0].T_first_second @ atlas.keyframes[-1].T_map_camera
    atlas.move(newest, se3.exp(np.full(6, 0.1)) @ atlas.T_world_submap(newest))
    start_next(atlas, slam.mapper)
    closer.submap_started(atlas, 0, np.zeros((6, 6)))
    link = closer._graph.odometry.links[-1]
    assert (link.first, link.second) == (newest, newest + 1)
    assert np.abs(link.T_first_second - expected).max() < 1e-6
    assert closer.enterable(atlas)[:1] == [0] and closer.origin(atlas) == 0


def test_the_way_back_is_the_shortest_one(monkeypatch):
    """Changes between earlier submaps do not make it longer."""
    there = se3.exp(np.array([2.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    monkeypatch.setattr(SubmapOdometry, "_path_in", lambda *_: [np.eye(4), there])
    odometry, found = (
        SubmapOdometry(OdometryNoise()),
        SimpleNamespace(T_submap_camera=there, result=SimpleNamespace(information=1e8 * np.eye(6))),
    )

    def changed(left, to):
        odometry.entered(AtlasOfThree(to), left, there, found)
        return np.trace(odometry.ways_back[0].covariance)

    before = changed(2, 0)
    for _ in range(10):
        changed(0, 1)
        assert changed(1, 0) == before


def test_without_loops_between_submaps_entering_one_adds_none(there_and_back):
    slam = new_slam(closing=ClosingOptions(between=False))
    results = fed(slam, there_and_back[0])
    assert results[-1].submap == 0 and slam._closer.loops == []


@pytest.mark.parametrize("full", [False, True])
def test_a_submap_that_shows_a_part_of_the_view_is_entered_unless_it_is_full(
    slam, there_and_back, monkeypatch, full
):
    frames = there_and_back[0]
    known = len(slam.atlas)
    assert known > 2 and slam.atlas.active == 0 and slam.atlas.visited > 0
    changes = submap_changes.SubmapChanges
    monkeypatch.setattr(Atlas, "is_full", lambda self, submap: full)
    monkeypatch.setattr(changes, "_nearest", lambda *_: None)  # none shows all of it
    monkeypatch.setattr(changes, "_leaves", lambda *_: slam.atlas.active == 0)
    results = fed(slam, following(frames[: COUNT // 2], len(frames)))
    assert (len(slam.atlas) > known) == full
    assert full or 0 < results[-1].submap < known


def test_a_full_submap_does_not_grow_while_it_shows_the_view(slam, there_and_back, monkeypatch):
    frames = there_and_back[0]
    known, count = len(slam.atlas), len(slam.atlas.keyframes)
    changes = submap_changes.SubmapChanges
    monkeypatch.setattr(Atlas, "is_full", lambda self, submap: True)
    monkeypatch.setattr(changes, "_nearest", lambda *_: None)
    monkeypatch.setattr(changes, "_leaves", lambda *_: False)
    results = fed(slam, following(frames[:COUNT], len(frames)))
    assert {result.submap for result in results} == {0}
    assert (len(slam.atlas), len(slam.atlas.keyframes)) == (known, count)
    assert all(result.T_map_camera is not None for result in results)


def test_a_progress_bar_follows_the_steps_of_the_refinement(there_and_back):
    slam = new_slam()
    fed(slam, there_and_back[0][:12])
    taken = []

    def progress(steps):
        taken.append(len(steps))
        for step in steps:
            yield step
            taken.append(step)

    slam.finish(progress)
    keyframes = [len(submap.keyframe_indices) for submap in slam.result().submaps]
    assert len(keyframes) > 1 and taken[0] == sum(step_count(FEW, count) for count in keyframes)
    assert taken[1:] == list(range(taken[0])), "the bar is complete"
