"""Submaps: when one begins, where it rests, and what its neighbour takes over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.semantics.labeller import Labeller
from toolkit.semantics.segmenters.geometric import GeometricSegmenter
from toolkit.semantics.trees import shipped_taxonomy
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.submaps import allocation
from toolkit.slam.submaps.allocation import Allocation, path_length_m, view_overlap
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.factory import allocation_options
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.slam.submaps.options import AllocationOptions, BoundaryOptions
from toolkit.slam.submaps.store import SavedSubmaps, SubmapStore
from toolkit.slam.submaps.submap import Submap
from toolkit.slam.system import Slam
from toolkit.slam.tracking.given import GivenPoses
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import render

FEW = MapperOptions(iterations=3, first_iterations=10, final_iterations=2)


@pytest.fixture(scope="module")
def room():
    return tiny_room(14, 96, 72)


@pytest.fixture(scope="module")
def keyframes(room):
    frames, truth = room
    return [Keyframe.from_frame(f, T) for f, T in zip(frames, truth.T_world_camera, strict=True)]


def turned(keyframe, degrees):
    """The keyframe as if its camera had looked elsewhere."""
    T_self_other = se3.exp(np.array([0, 0, 0, 0, np.radians(degrees), 0]))
    return replace(keyframe, T_map_camera=keyframe.T_map_camera @ T_self_other)


def labelled(keyframe, class_id):
    ids = torch.full(keyframe.depth_m.shape, class_id, dtype=torch.int16)
    return replace(keyframe, class_ids=ids)


class TestOverlap:
    def overlap(self, keyframe, others):
        return view_overlap(keyframe, others)

    def test_a_view_lies_inside_its_own_volume(self, keyframes):
        assert self.overlap(keyframes[0], [keyframes[0]]) > 0.9

    def test_a_view_to_the_other_side_does_not(self, keyframes):
        assert self.overlap(turned(keyframes[0], 180), [keyframes[0]]) < 0.2

    def test_a_volume_ends_at_the_wall(self, keyframes):
        near = replace(keyframes[0], depth_m=keyframes[0].depth_m * 0.5)
        assert self.overlap(keyframes[0], [near]) < 0.1

    def test_a_keyframe_without_depth_has_no_overlap(self, keyframes):
        blind = replace(keyframes[0], points=np.zeros((0, 3), np.float32))
        assert self.overlap(blind, [keyframes[0]]) == 0.0

    def test_the_union_of_all_keyframes_is_used(self, keyframes):
        first, other = keyframes[0], turned(keyframes[0], 40)
        half = turned(first, 20)
        single = [self.overlap(half, [k]) for k in (first, other)]
        assert self.overlap(half, [first, other]) > max(single) + 0.05

    def test_it_equals_the_fraction_of_projected_points(self, keyframes):
        first, other = keyframes[0], turned(keyframes[0], 40)
        for degrees in (5, 20, 35, 60):
            view = turned(first, degrees)
            points = view.points_in_map()
            expected = (first.reaches(points) | other.reaches(points)).mean()
            assert 0.0 < expected < 1.0
            assert self.overlap(view, [first, other]) == pytest.approx(expected, abs=1e-12)


class TestAllocation:
    def judge(self, keyframes, classes=0, gaussians=0, **options):
        values = {"min_keyframes": 2, "recent": 1} | options
        return Allocation(AllocationOptions(**values), classes).judge(3, keyframes, gaussians)

    def test_the_rule_of_motion_looks_at_the_anchor_alone(self, keyframes):
        near, far = turned(keyframes[0], 40), turned(keyframes[0], 60)
        assert not self.judge([keyframes[0], near], rule="motion").starts_submap
        assert "60 degrees" in self.judge([keyframes[0], far], rule="motion").reason
        for metres, starts in ((0.4, False), (0.6, True)):
            T = keyframes[0].T_map_camera @ se3.exp(np.array([metres, 0, 0, 0, 0, 0]))
            moved = replace(keyframes[0], T_map_camera=T)
            assert self.judge([keyframes[0], moved], rule="motion").starts_submap == starts
        # Whatever it sees, and however small the submap is.
        assert not self.judge([far, far, far], rule="motion").starts_submap

    def test_each_segmenter_has_its_own_threshold(self):
        labeller = Labeller(GeometricSegmenter(), shipped_taxonomy("geometric"))
        own = allocation_options(AllocationOptions(), labeller)
        assert own.min_divergence == labeller.segmenter.place_divergence < 0.4
        asked = allocation_options(AllocationOptions(min_divergence=0.7), labeller)
        assert asked.min_divergence == 0.7
        assert allocation_options(AllocationOptions(), None) == AllocationOptions()

    def test_elsewhere_without_labels_is_enough(self, keyframes):
        verdict = self.judge([keyframes[0], turned(keyframes[0], 180)])
        assert verdict.starts_submap and "overlap" in verdict.reason
        assert np.isnan(verdict.divergence) and verdict.submap == 3

    def test_elsewhere_among_the_same_things_is_not(self, keyframes):
        views = [labelled(k, 1) for k in (keyframes[0], turned(keyframes[0], 180))]
        verdict = self.judge(views, classes=4)
        assert not verdict.starts_submap and verdict.divergence == 0.0

    def test_elsewhere_among_other_things_is(self, keyframes):
        views = [labelled(keyframes[0], 1), labelled(turned(keyframes[0], 180), 2)]
        assert self.judge(views, classes=4).divergence > 0.4
        assert self.judge(views, classes=4).starts_submap

    def test_other_things_at_the_same_place_are_not(self, keyframes):
        views = [labelled(keyframes[0], 1), labelled(keyframes[0], 2)]
        assert not self.judge(views, classes=4).starts_submap

    def test_small_submaps_go_on(self, keyframes):
        views = [keyframes[0], turned(keyframes[0], 180)]
        assert not self.judge(views, min_keyframes=3).starts_submap

    @pytest.mark.parametrize(
        ("options", "gaussians", "word"),
        [
            ({"max_keyframes": 2}, 0, "keyframes"),
            ({"max_gaussians": 10}, 10, "Gaussians"),
            ({"max_path_m": 1e-4}, 0, "path"),
        ],
    )
    def test_caps_act_alone(self, keyframes, options, gaussians, word):
        verdict = self.judge(keyframes[:2], gaussians=gaussians, **options)
        assert verdict.starts_submap and word in verdict.reason

    def test_limits_are_reached_where_they_are_met(self, keyframes, monkeypatch):
        pair = keyframes[:2]
        length_m = path_length_m(pair)
        assert "path" in self.judge(pair, max_path_m=length_m).reason
        view = [keyframes[0], turned(keyframes[0], 40)]
        overlap = self.judge(view).overlap
        assert 0.2 < overlap < 1.0
        monkeypatch.setattr(allocation, "_MIN_OVERLAP", overlap)
        assert not self.judge(view).starts_submap

    def test_recent_keyframes_do_not_count_as_the_volume(self, keyframes):
        """The last one always shows what the newest one shows; only the anchor always counts."""
        away = turned(keyframes[0], 180)
        views = [keyframes[0], away, away]
        assert self.judge(views, recent=1).overlap > 0.9
        assert self.judge(views, recent=2).overlap < 0.2
        assert self.judge(views, recent=9).overlap < 0.2

    def test_verdicts_survive_json(self, keyframes):
        verdict = self.judge([keyframes[0], turned(keyframes[0], 180)])
        again = type(verdict).from_values(verdict.values())
        assert verdict.values()["divergence"] is None and np.isnan(again.divergence)
        assert replace(again, divergence=0.0) == replace(verdict, divergence=0.0)

    def test_the_path_is_what_the_camera_went(self, keyframes):
        steps = [np.eye(4) for _ in range(3)]
        steps[1][0, 3] = steps[2][0, 3] = 1.0
        steps[2][1, 3] = 2.0
        views = [replace(keyframes[0], T_map_camera=T) for T in steps]
        assert path_length_m(views) == pytest.approx(3.0)
        back = [*views, views[1], views[0]]
        assert path_length_m(back) == pytest.approx(3.0), "the way back adds nothing"

    def test_with_enough_keyframes_a_submap_goes_on_where_it_is(self, keyframes):
        there, elsewhere = keyframes[:3], turned(keyframes[0], 180)
        caps = {"enough_keyframes": 3, "min_keyframes": 9}
        assert not self.judge(there, **caps).starts_submap
        assert "overlap" in self.judge([*there[:2], elsewhere], **caps).reason
        assert not self.judge([there[0], elsewhere], **caps).starts_submap


def some_submap(number, count=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    cloud = GaussianCloud.from_values(
        torch.rand(count, 3, generator=g),
        torch.full((count,), 0.01),
        torch.full((count,), 0.8),
        torch.rand(count, 3, generator=g),
        torch.rand(count, 4, generator=g),
    )
    ids = torch.arange(count, dtype=torch.int32)
    return Submap(
        number, se3.exp(np.arange(6) * 0.1), cloud, [], ids, optimiser=OptimiserState(ids + 1)
    )


def same(a, b):
    arrays, values = a.state()
    others, other_values = b.state()
    return values == other_values and all(
        np.array_equal(arrays[k], others[k]) for k in arrays | others
    )


class TestSubmap:
    def test_another_number_and_offset_keep_the_content(self, keyframes):
        submap = replace(some_submap(1), keyframes=keyframes[2:4])
        other = submap.renumbered(4, -100)
        assert other.number == 4 and [k.index for k in other.keyframes] == [-98, -97]
        assert torch.equal(other.seeded_by, submap.seeded_by - 100)
        assert [k.index for k in submap.keyframes] == [2, 3]

    def test_it_goes_to_a_device_once(self):
        submap = some_submap(0)
        assert submap.to("cpu") is submap
        there = submap.to("meta")
        assert there.device.type == there.seeded_by.device.type == "meta"
        assert there.optimiser.steps.device.type == "meta" and submap.device.type == "cpu"

    def test_without_a_current_submap_there_is_none_to_work_on(self):
        atlas = Atlas(some_submap(0))
        assert atlas.current.number == 0 and len(atlas.gaussians) == 50
        atlas.store_active()
        assert not atlas.has_active_submap and not len(atlas.gaussians) and atlas.keyframes == []
        with pytest.raises(RuntimeError, match="no submap is active"):
            _ = atlas.current

    def test_an_earlier_one_goes_on(self, keyframes, tmp_path):
        atlas = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        atlas.current.keyframes.extend(keyframes[:2])
        atlas.start(replace(some_submap(1, seed=1), keyframes=[keyframes[1]]))
        assert (atlas.active, atlas.visited) == (1, 0)
        atlas.enter(0)
        assert (atlas.active, atlas.visited) == (0, 2)
        assert [k.index for k in atlas.keyframes] == [0, 1]
        assert list(atlas.keyframe_poses(1)) == [1]
        atlas.current.keyframes.append(keyframes[2])

        again = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        again.restore(*atlas.state())
        assert (again.active, again.visited, len(again)) == (0, 2, 2)
        assert same(again.current, atlas.current) and same(again.submap(1), atlas.submap(1))
        again.enter(1)
        assert [k.index for k in again.submap(0).keyframes] == [0, 1, 2]
        assert list(again.keyframe_poses(0)) == [0, 1, 2]

    def test_what_did_not_change_is_not_written_again(self, keyframes, tmp_path):
        atlas = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        atlas.current.keyframes.extend(keyframes[:2])
        atlas.start(some_submap(1, seed=1))
        for number in (0, 1, 0):
            atlas.enter(number)
            again = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
            again.restore(*atlas.state())
            again.store_active()
            assert again.stored_versions == {"0": 0, "1": 0}
        assert sorted(path.name for path in tmp_path.iterdir()) == ["0000_0", "0001_0"]
        before = atlas.current.gaussians.means.clone()
        atlas.current.optimiser.moments(atlas.gaussians)
        atlas.gaussians.means.add_(1.0)
        atlas.enter(1)
        assert atlas.stored_versions == {"0": 1, "1": 0}
        assert torch.equal(atlas.submap(0).gaussians.means, before + 1.0)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["0000_1", "0001_0"]

    def test_a_run_that_was_resumed_once_can_be_resumed_again(self, keyframes, tmp_path):
        atlas = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        atlas.current.keyframes.extend(keyframes[:2])
        atlas.start(replace(some_submap(1, seed=1), keyframes=[keyframes[1]]))
        atlas.enter(0)
        balances = atlas.keyframe_balances(0)
        for number in (1, 0):
            again = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
            again.restore(*atlas.state())
            again.enter(number)  # without a change of the one before
            assert again.keyframe_balances(0) == balances
            atlas = again

    @pytest.mark.parametrize("more", [True, False])
    def test_the_active_one_survives_the_loss_of_its_stored_version(
        self, keyframes, tmp_path, more
    ):
        atlas = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        atlas.current.keyframes.extend(keyframes[:2])
        atlas.start(replace(some_submap(1, seed=1), keyframes=[keyframes[1]]))
        atlas.enter(0)
        if more:
            atlas.current.keyframes.append(keyframes[2])
        count = len(atlas.keyframes)
        (tmp_path / "0000_0" / "arrays.npz").write_bytes(b"")
        again = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        again.restore(*atlas.state())
        assert again.unreadable == []
        again.enter(1)
        assert again.stored_versions == {"0": 1, "1": 0}
        assert len(again.submap(0).keyframes) == count

    def test_one_that_cannot_be_read_is_not_entered(self, keyframes, tmp_path):
        atlas = Atlas(some_submap(0), store=SubmapStore(tmp_path, budget_mb=0))
        for number in (1, 2):  # only the last one that was used is in memory
            atlas.start(some_submap(number))
        (tmp_path / "0000_0" / "arrays.npz").write_bytes(b"")
        with pytest.raises(FormatError):
            atlas.enter(0)
        assert atlas.active == 2 and atlas.current.number == 2


class TestStore:
    def test_what_is_read_is_what_was_put(self, tmp_path, keyframes):
        submap = replace(some_submap(0), keyframes=keyframes[:2])
        store = SubmapStore(tmp_path, budget_mb=0)
        store.put(submap)
        store.put(some_submap(1))
        found = store.get(0)
        assert found is not submap and same(found, submap)

    def test_within_the_budget_nothing_is_read(self, tmp_path):
        store = SubmapStore(tmp_path)
        submap = some_submap(0)
        store.put(submap)
        store.put(some_submap(1))
        assert store.get(0) is submap

    def test_without_a_folder_everything_stays(self):
        store = SubmapStore(None, budget_mb=0)
        submaps = [some_submap(n) for n in range(3)]
        for submap in submaps:
            store.put(submap)
        assert all(store.get(n) is submap for n, submap in enumerate(submaps))

    def test_an_older_state_finds_what_it_knew(self, tmp_path):
        store = SubmapStore(tmp_path)
        store.put(some_submap(0, seed=1))
        before = store.state()
        store.put(some_submap(0, seed=2))
        again = SubmapStore(tmp_path)
        assert again.restore(before) == []
        assert same(again.get(0), some_submap(0, seed=1))

    def test_compressed_submaps_are_read_as_before(self, tmp_path, caplog, keyframes):
        store = SubmapStore(tmp_path, budget_mb=0)
        submap = replace(some_submap(0), keyframes=keyframes[:2])
        store.put(submap)
        store.put(some_submap(1))
        sizes = [(tmp_path / f"{n:04d}_0" / "arrays.npz").stat().st_size for n in range(2)]
        (tmp_path / "0001_0" / "arrays.npz").unlink()
        store.compress()
        assert (tmp_path / "0000_0" / "arrays.npz").stat().st_size < 0.8 * sizes[0]
        assert same(store.get(0), submap)
        assert "A submap stays uncompressed: cannot write" in caplog.text

    def test_pruning_keeps_what_states_know(self, tmp_path):
        store = SubmapStore(tmp_path)
        states = []
        for seed in range(3):
            store.put(some_submap(0, seed=seed))
            states.append(store.state())
        store.prune(states[1])
        assert sorted(p.name for p in tmp_path.iterdir()) == ["0000_1", "0000_2"]

    @pytest.mark.parametrize("damage", ["missing", "cut"])
    def test_a_lost_submap_is_named_and_the_rest_kept(self, tmp_path, caplog, damage):
        store = SubmapStore(tmp_path)
        for number in range(3):
            store.put(some_submap(number))
        arrays = tmp_path / "0001_0" / "arrays.npz"
        if damage == "missing":
            arrays.unlink()
        else:
            arrays.write_bytes(arrays.read_bytes()[:100])
        again = SubmapStore(tmp_path, budget_mb=0)
        assert again.restore(store.state()) == [1]
        assert "Submap 1 cannot be read" in caplog.text and "0001_0" in caplog.text
        assert same(again.get(2), some_submap(2))
        with pytest.raises((FormatError, RunFolderError)):
            again.get(1)

    @given(st.lists(st.integers(0, 4), min_size=1, max_size=12))
    def test_any_order_of_reading_gives_the_same(self, tmp_path_factory, order):
        store = SubmapStore(tmp_path_factory.mktemp("store"), budget_mb=0.01)
        for number in range(5):
            store.put(some_submap(number, seed=number))
        assert all(same(store.get(n), some_submap(n, seed=n)) for n in order)


def cut_slam(room, folder=None, every=2, inherit=True):
    """Maps with given poses, a new submap at every second keyframe."""
    _, truth = room
    mapper = Mapper(FEW, np.random.default_rng(0))
    allocation = Allocation(AllocationOptions(max_keyframes=every), 0)
    boundary = BoundaryOptions(inherit=inherit)
    atlas = Atlas(mapper.first_submap(), allocation, SubmapStore(folder, 0.0), boundary)
    return Slam(FrontEnd(GivenPoses(truth)), mapper, atlas=atlas)


@pytest.fixture
def cut(room, tmp_path):
    slam = cut_slam(room, tmp_path)
    for frame in room[0]:
        slam.process_frame(frame)
    return slam


class TestAtlas:
    def test_the_path_goes_through(self, cut, room):
        assert len(cut.atlas) > 1
        assert np.allclose(
            cut.result().trajectory.T_world_camera, room[1].T_world_camera, atol=1e-9
        )

    def test_a_result_has_its_place_in_the_world(self, room, tmp_path):
        slam = cut_slam(room, tmp_path)
        results = [slam.process_frame(frame) for frame in room[0]]
        found = np.array([result.T_world_camera for result in results])
        assert np.allclose(found, room[1].T_world_camera, atol=1e-9)

    def test_the_boundary_belongs_to_both(self, cut):
        atlas = cut.atlas
        for number in range(1, len(atlas)):
            old, new = atlas.keyframe_poses(number - 1), atlas.keyframe_poses(number)
            boundary = next(iter(new))
            assert boundary == list(old)[-1]
            assert np.array_equal(new[boundary], np.eye(4))
            T_world_boundary = atlas.T_world_submap(number - 1) @ old[boundary]
            assert np.allclose(T_world_boundary, atlas.T_world_submap(number))
        indices = cut.result().keyframe_indices
        assert len(indices) == len(set(indices))

    def test_the_new_one_shows_what_its_anchor_saw(self, room, tmp_path):
        frames, _ = room
        slam = cut_slam(room, tmp_path)
        for frame in frames:
            before = len(slam.atlas)
            slam.process_frame(frame)
            if len(slam.atlas) > before:
                break
        keyframe = slam.atlas.keyframes[0]
        shown = render(slam.atlas.gaussians, frame.camera, se3.inverse(keyframe.T_map_camera))
        assert float(shown.silhouette.mean()) > 0.9
        assert set(slam.atlas.current.seeded_by.tolist()) == {frame.index}

    def test_without_inheritance_the_anchor_alone_seeds(self, room):
        slam = cut_slam(room, inherit=False)
        for frame in room[0][:6]:
            slam.process_frame(frame)
        assert len(slam.atlas) > 1 and len(slam.atlas.gaussians) > 0

    def test_a_moved_anchor_moves_its_frames_alone(self, cut):
        before, atlas = cut.result().trajectory.T_world_camera, cut.atlas
        content = atlas.submap(1).state()[0]["gaussians/means"].copy()
        move = se3.exp(np.array([0.1, 0.0, 0.2, 0.0, 0.1, 0.0]))
        atlas.move(1, move @ atlas.T_world_submap(1))
        after = cut.result().trajectory.T_world_camera
        moved = [not np.allclose(a, b) for a, b in zip(after, before, strict=True)]
        assert any(moved) and not all(moved)
        assert np.allclose(after[moved], move @ before[moved])
        assert np.array_equal(atlas.submap(1).state()[0]["gaussians/means"], content)

    def test_a_single_submap_is_the_map_itself(self, room):
        slam = Slam(FrontEnd(GivenPoses(room[1])), Mapper(FEW, np.random.default_rng(0)))
        for frame in room[0][:4]:
            slam.process_frame(frame)
        slam.finish()
        assert slam.result().gaussians is slam.atlas.submap(0).gaussians
        assert slam.result().map.submap.unique().tolist() == [0]

    def test_it_goes_on_from_a_checkpoint_to_the_same_bits(self, room, tmp_path):
        frames, _ = room

        def ended(cut_at):
            folder = tmp_path / str(cut_at)
            slam = cut_slam(room, folder)
            for frame in frames[:cut_at]:
                slam.process_frame(frame)
            arrays, values = slam.state()
            slam = cut_slam(room, folder)
            slam.restore(arrays, values)
            for frame in frames[cut_at:]:
                slam.process_frame(frame)
            slam.finish()
            return slam

        a, b = ended(4), ended(11)
        assert np.array_equal(
            a.result().trajectory.T_world_camera, b.result().trajectory.T_world_camera
        )
        assert torch.equal(a.result().gaussians.means, b.result().gaussians.means)
        # As values: a divergence that is not known is NaN, which differs from itself.
        verdicts = [[v.values() for v in slam.atlas.verdicts] for slam in (a, b)]
        assert verdicts[0] == verdicts[1]
        assert sum(v.starts_submap for v in a.atlas.verdicts) == len(a.atlas) - 1 > 1

    def test_old_contents_go_once_two_checkpoints_have_passed(self, room, tmp_path):
        slam = cut_slam(room, tmp_path)
        for frame in room[0]:
            slam.process_frame(frame)
        atlas = slam.atlas
        atlas.checkpointed()
        atlas.put(atlas.submap(0))
        atlas.checkpointed()
        assert {"0000_0", "0000_1"} <= {p.name for p in tmp_path.iterdir()}
        atlas.checkpointed()
        assert "0000_0" not in {p.name for p in tmp_path.iterdir()}


class TestFusion:
    def test_the_joined_map_shows_the_room(self, cut, room):
        frames, truth = room
        fused = cut.finish().map
        assert fused.submap.unique().numel() == len(cut.atlas)
        gaussians = fused.gaussians
        errors = []
        for frame, T in zip(frames, truth.T_world_camera, strict=True):
            drawn = render(gaussians, frame.camera, se3.inverse(T))
            errors.append(((drawn.colour.numpy() - frame.rgb) ** 2).mean())
        assert -10 * np.log10(np.mean(errors)) > 22.0

    def test_overlaps_are_fused_once(self, cut, room):
        whole = Slam(FrontEnd(GivenPoses(room[1])), Mapper(FEW, np.random.default_rng(0)))
        for frame in room[0]:
            whole.process_frame(frame)
        together, separate = whole.finish().gaussians, cut.finish().gaussians
        parts = sum(len(cut.atlas.submap(n).gaussians) for n in range(len(cut.atlas)))
        assert len(separate) < 0.9 * parts
        assert len(separate) < 1.35 * len(together)

    def test_a_lost_submap_is_left_out(self, cut):
        cut.atlas.unreadable.append(0)
        assert 0 not in cut.finish().map.submap.unique().tolist()


class TestSavedSubmaps:
    def test_the_last_version_of_each_is_read(self, tmp_path):
        store = SubmapStore(tmp_path)
        for seed in range(12):  # past the first version of two digits
            store.put(some_submap(3, seed=seed))
        store.put(some_submap(12, seed=5))
        (tmp_path / ".writing-x").mkdir()
        anchors = {12: np.eye(4), 3: se3.exp(np.arange(6) * 0.2)}
        saved = SavedSubmaps(SubmapStore.newest(tmp_path), anchors)
        assert list(saved) == [3, 12] and len(saved) == 2
        assert torch.equal(saved[3].gaussians.means, some_submap(3, seed=11).gaussians.means)
        assert np.array_equal(saved[3].T_world_submap, anchors[3])

    def test_a_folder_that_is_not_there_has_none(self, tmp_path):
        assert 0 not in SubmapStore.newest(tmp_path / "none")
