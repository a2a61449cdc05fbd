"""From candidates to moved anchors: what is verified corrects, what is not leaves no trace."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.base.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.base.pose_graph.options import PoseGraphOptions
from toolkit.base.pose_graph.retraction import PoseGraphOptimiser
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.candidates import CandidateFinder
from toolkit.slam.loops.closing import pair_matching, submap_loops
from toolkit.slam.loops.closing.closer import LoopCloser
from toolkit.slam.loops.closing.image_edges import ImageEdges, ImageLoops
from toolkit.slam.loops.closing.object_loops import ObjectHypotheses, ObjectHypothesis
from toolkit.slam.loops.closing.options import ClosingOptions
from toolkit.slam.loops.closing.pair_matching import PairMatcher, RoughMotion, VerifiedPair
from toolkit.slam.loops.closing.parts import ClosingParts
from toolkit.slam.loops.closing.submap_loops import SubmapLoops
from toolkit.slam.loops.constellations import Constellation, ConstellationMatch
from toolkit.slam.loops.detection import LoopDetector
from toolkit.slam.loops.log import LoopLog, read_loop_log
from toolkit.slam.loops.options import CandidateOptions
from toolkit.slam.loops.registration.result import RegistrationResult, failed
from toolkit.slam.loops.relocalisation import Relocaliser
from toolkit.slam.loops.verification import VerificationLimits
from toolkit.slam.mapping.boundary import start_next
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.submaps.allocation import Allocation
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.options import AllocationOptions
from toolkit.slam.tracking.reach import Reach
from toolkit.splatting.alignment.data import ResidualScales
from toolkit.splatting.alignment.matching import Offset

FEW = MapperOptions(iterations=1, first_iterations=2, final_iterations=1)
EAGER = CandidateOptions(
    search_every=1,
    min_gap_frames=4,
    min_gap_m=0.0,
    threshold="fixed",
    distance=0.5,
)


@pytest.fixture(scope="module")
def frames():
    """Frames of a room, and the first ones again: the camera came back."""
    seen, truth = tiny_room(6, 64, 48)
    again = [replace(f, index=20 + f.index, timestamp_s=20 + f.timestamp_s) for f in seen[:2]]
    poses = [*truth.T_world_camera, *truth.T_world_camera[:2]]
    start = se3.inverse(poses[0])
    return [(f, start @ T) for f, T in zip([*seen, *again], poses, strict=True)]


@pytest.fixture
def no_images(monkeypatch):
    """No image pair is verified."""
    monkeypatch.setattr(pair_matching, "_MAX_SIGMA_M", 1e-12)


class TrueRegistrar:
    """Knows where submaps lie, as no registrar does."""

    def __init__(self, truth, **changes):
        self.truth, self.changes, self.asked = truth, changes, []

    def register(self, target, source, T_target_source=None):
        self.asked.append((target.number, source.number))
        if "fails" in self.changes:
            return failed("test", "nothing in common")
        T = se3.inverse(self.truth[target.number]) @ self.truth[source.number]
        if "wrong" in self.changes:
            T = T @ se3.exp(np.array([2.0, 0.0, 1.0, 0.0, 0.5, 0.0]))
        result = RegistrationResult(
            T,
            True,
            0.95,
            ResidualScales(0.02, 0.003),
            0.7,
            float("nan"),
            np.eye(6) * 1e8,
            1,
            1,
            "test",
        )
        return replace(result, **{k: v for k, v in self.changes.items() if hasattr(result, k)})


DRIFT = se3.exp(np.array([0.02, 0.0, 0.015, 0.0, 0.01, 0.0]))


def closed(
    frames,
    registrar_changes=None,
    log=None,
    options=None,
    nearby_changes=None,
    max_keyframes=3,
):
    """An atlas of three submaps, the last of which drifted, and its closer.

    The second registrar has the errors of the first unless `nearby_changes` are given.
    """
    mapper = Mapper(FEW, np.random.default_rng(0))
    atlas = Atlas(
        mapper.first_submap(),
        Allocation(AllocationOptions(max_keyframes=max_keyframes), 0),
    )
    truth = {0: np.eye(4)}
    registrar = TrueRegistrar(truth, **(registrar_changes or {}))
    encoder = BuiltinEncoder()
    detector = LoopDetector(
        ViewDescriber(encoder), CandidateFinder(encoder.dimensions, encoder.threshold, EAGER)
    )
    parts = ClosingParts(
        registrar=registrar,
        nearby=registrar if nearby_changes is None else TrueRegistrar(truth, **nearby_changes),
        matcher=PairMatcher(),
        relocaliser=Relocaliser(detector),
        verification=VerificationLimits(),
        pose_graph=PoseGraphOptions(),
        noise=OdometryNoise(),
        loop_noise=LoopNoise(edge_m=0.001, edge_rad=0.001),
        optimiser=PoseGraphOptimiser(),
    )
    closer = LoopCloser(detector, parts, options, log)
    T_map_world = np.eye(4)
    for frame, T_world_camera in frames:
        drift = DRIFT if frame.index >= 20 else np.eye(4)
        keyframe = Keyframe.from_frame(frame, T_map_world @ drift @ T_world_camera)
        mapper.add_keyframe(atlas.current, keyframe)
        closer.keyframe_added(atlas)
        if atlas.judge().starts_submap:
            start_next(atlas, mapper)
            closer._graph.odometry.started(atlas, atlas.active - 1, np.eye(6) * 1e6)
            truth[atlas.active] = T_world_camera
            T_map_world = se3.inverse(atlas.T_world_submap(atlas.active))
    return atlas, closer, registrar


def bits(atlas):
    anchors = [atlas.T_world_submap(n).tobytes() for n in range(len(atlas))]
    return anchors, [atlas.submap(n).gaussians.means.numpy().tobytes() for n in range(len(atlas))]


class TestBetween:
    def test_a_verified_loop_takes_the_drift_out(self, frames):
        atlas, closer, registrar = closed(frames)
        last = atlas.active
        before = atlas.T_world_submap(last).copy()
        contents = bits(atlas)[1]
        assert closer.close_between(atlas, last)
        assert registrar.asked
        # Its own keyframes drifted inside the submap; the anchor goes where its loop says.
        true = registrar.truth[last]
        error = np.linalg.norm((se3.inverse(true) @ atlas.T_world_submap(last))[:3, 3])
        assert error < 0.5 * np.linalg.norm((se3.inverse(true) @ before)[:3, 3]) + 1e-3
        assert bits(atlas)[1] == contents, "nothing inside a submap changes"

    @pytest.mark.parametrize("deferred", [False, True])
    def test_loops_of_an_ended_submap_are_closed_by_finish_if_deferred(self, frames, deferred):
        atlas, closer, registrar = closed(frames)
        if deferred:
            closer.defer()
        ended = atlas.active
        start_next(atlas, Mapper(FEW))
        registrar.truth[atlas.active] = frames[-1][1]
        closer.submap_started(atlas, atlas.active - 1, np.eye(6) * 1e6)
        assert bool(registrar.asked) is not deferred
        closer.finish(atlas, Mapper(FEW))
        assert any(second == ended for _, second in registrar.asked)
        assert closer.loops

    @pytest.mark.parametrize(
        "changes",
        [{"fails": True}, {"overlap": 0.1}, {"inliers": 0.3}, {"class_agreement": 0.2}],
    )
    def test_what_is_not_verified_leaves_no_trace(self, frames, no_images, changes):
        atlas, closer, registrar = closed(frames, changes)
        before = bits(atlas)
        assert not closer.close_between(atlas, atlas.active)
        assert registrar.asked and bits(atlas) == before and not closer.loops

    def test_a_loop_against_the_odometry_is_refused(self, frames, tmp_path, monkeypatch, no_images):
        log = LoopLog(tmp_path / "loops.jsonl")
        # As between identical rooms, where the views do agree.
        monkeypatch.setattr(submap_loops, "_MIN_SHARED", 0.0)
        atlas, closer, registrar = closed(frames, {"wrong": True}, log)
        before = bits(atlas)
        assert not closer.close_between(atlas, atlas.active)
        assert bits(atlas) == before and not closer.loops
        refused = [r for r in read_loop_log(tmp_path / "loops.jsonl") if r["kind"] == "between"]
        assert len(refused) == len(registrar.asked) == 2 * len(set(registrar.asked))
        assert all("odometry" in r["reason"] and not r["accepted"] for r in refused)

    def test_the_true_place_is_found_where_a_look_alike_came_first(self, frames, tmp_path):
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, registrar = closed(frames, {"wrong": True}, log, nearby_changes={})
        assert closer.close_between(atlas, atlas.active)
        alike, true = [
            r for r in read_loop_log(tmp_path / "loops.jsonl") if r["kind"] == "between"
        ][:2]
        assert "odometry" in alike["reason"] and true["accepted"]
        for loop in closer.loops:
            T = se3.inverse(registrar.truth[loop.first]) @ registrar.truth[loop.second]
            assert np.allclose(loop.T_first_second, T, atol=1e-6)

    def test_verified_images_give_the_edge_where_registration_fails(self, frames, tmp_path):
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, registrar = closed(frames, {"fails": True}, log)
        assert closer.close_between(atlas, atlas.active) and registrar.asked
        for loop in closer.loops:
            T = se3.inverse(registrar.truth[loop.first]) @ registrar.truth[loop.second]
            # The keyframes of the last submap drifted with its anchor.
            assert np.linalg.norm((se3.inverse(T) @ loop.T_first_second)[:3, 3]) < 0.03
        taken = [r for r in read_loop_log(tmp_path / "loops.jsonl") if r["kind"] == "images"]
        assert any(r["accepted"] for r in taken)

    def test_images_contradict_a_registration_that_the_odometry_allows(
        self, frames, tmp_path, monkeypatch
    ):
        monkeypatch.setattr(submap_loops, "_MAX_IMAGE_DIFFERENCE_M", 1e-6)
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(frames, log=log)
        closer.close_between(atlas, atlas.active)
        refused = [r for r in read_loop_log(tmp_path / "loops.jsonl") if r["kind"] == "between"]
        assert any("the images differ" in r["reason"] and not r["accepted"] for r in refused)

    def test_what_the_odometry_allows_is_not_tried_again(self, frames):
        atlas, closer, registrar = closed(frames, {"overlap": 0.1})
        closer.close_between(atlas, atlas.active)
        assert len(registrar.asked) == len(set(registrar.asked))

    def test_submaps_that_fit_prove_no_other_suspicion(
        self, frames, tmp_path, monkeypatch, no_images
    ):
        monkeypatch.setattr(submap_loops, "_MIN_SHARED", 1.01)
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(frames, log=log)
        assert not closer.close_between(atlas, atlas.active) and not closer.loops
        refused = [r for r in read_loop_log(tmp_path / "loops.jsonl") if r["kind"] == "verified"]
        assert refused and not any(r["accepted"] for r in refused)

    def test_without_tests_a_registration_is_the_edge(self, frames, tmp_path, monkeypatch):
        """The images of no pair match, none is shared, and the odometry contradicts the result."""
        monkeypatch.setattr(PairMatcher, "most_matches", lambda *_: [])
        monkeypatch.setattr(submap_loops, "_MIN_SHARED", 1.01)
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(frames, {"wrong": True}, log)
        untested = PoseGraphOptions(confidence=1.0, kernel="none")
        closer._parts = replace(
            closer._parts,
            verification=None,
            pose_graph=untested,
            optimiser=PoseGraphOptimiser(untested),
        )
        closer._graph._parts = closer._parts
        closer._between = SubmapLoops(closer._parts, closer.options, closer._record)
        assert closer.close_between(atlas, atlas.active) and closer.loops
        records = read_loop_log(tmp_path / "loops.jsonl")
        assert not {r["kind"] for r in records} & {"images", "consistency", "retracted"}
        assert all(r["accepted"] for r in records if r["kind"] == "verified")
        assert any(r["kind"] == "verified" for r in records)

    def test_it_can_be_left_out(self, frames):
        atlas, closer, registrar = closed(frames, options=ClosingOptions(between=False))
        assert not closer.close_between(atlas, atlas.active) and not registrar.asked

    def test_every_verdict_is_written_down(self, frames, tmp_path):
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(frames, log=log)
        closer.close_between(atlas, atlas.active)
        records = read_loop_log(tmp_path / "loops.jsonl")
        kinds = {record["kind"] for record in records}
        assert {"search", "candidate", "between", "verified", "correction between"} <= kinds
        assert all("reason" in r for r in records if r["kind"] in ("candidate", "between"))


def measured(monkeypatch, offset):
    """Let every pair of images match, with this offset."""
    rough = RoughMotion(np.eye(4), 50)
    monkeypatch.setattr(PairMatcher, "rough", lambda *_: rough)

    def verified(_, first, second, rough):
        return VerifiedPair(50, offset(first, second), "")

    monkeypatch.setattr(PairMatcher, "verified", verified)


@dataclass
class KnownObjects:
    """Objects that determine the true relative pose of two submaps, or wrong ones."""

    truth: dict
    errors: list

    def of(self, atlas, first, second, queries):
        pairs = [(q, m) for q in queries for m in list(atlas.keyframe_poses(first))[:1] if m < q]
        found = []
        for error in self.errors if pairs else ():
            T = se3.inverse(self.truth[first]) @ self.truth[second] @ error
            edge = PoseEdge.loop(first, second, T, np.eye(6) * 100.0)
            match = ConstellationMatch(T, np.zeros((6, 2), int), 0.05)
            found.append(ObjectHypothesis(edge, match, pairs))
        return found


def closed_by_objects(frames, monkeypatch, errors, log=None, **changes):
    """As `closed`, with images that do not match, and poses from objects with errors [K, 6]."""
    monkeypatch.setattr(PairMatcher, "most_matches", lambda *_: [])
    monkeypatch.setattr(submap_loops, "_MIN_SHARED", 0.0)
    atlas, closer, registrar = closed(frames, changes, log)
    objects = KnownObjects(registrar.truth, [se3.exp(np.array(error)) for error in errors])
    closer._between = SubmapLoops(
        replace(closer._parts, objects=objects), closer.options, closer._record
    )
    return atlas, closer


class TestObjects:
    DARK = ResidualScales(0.4, 0.003)

    def test_they_close_a_loop_in_other_light(self, frames, tmp_path, monkeypatch):
        log = LoopLog(tmp_path / "loops.jsonl")
        near = [0.02, 0.0, 0.01, 0.0, 0.01, 0.0]
        atlas, closer = closed_by_objects(frames, monkeypatch, [near], log, residual=self.DARK)
        assert closer.close_between(atlas, atlas.active) and closer.loops
        records = read_loop_log(tmp_path / "loops.jsonl")
        assert [r["objects"] for r in records if r["kind"] == "objects"] == [6] * len(closer.loops)
        assert any(r["kind"] == "verified" and r["accepted"] for r in records)

    def test_the_next_pose_is_tried_if_the_first_one_fails(self, frames, monkeypatch):
        """The odometry rules the first one out; the registration ends far from the second one."""
        errors = [[9.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0] * 6]
        atlas, closer = closed_by_objects(frames, monkeypatch, errors, residual=self.DARK)
        assert closer.close_between(atlas, atlas.active) and closer.loops

    @pytest.mark.parametrize(
        ("error", "changes"),
        [
            ([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], {}),
            ([0.0] * 6, {"inliers": 0.85}),
            ([0.0] * 6, {"class_agreement": 0.8}),
            ([0.0] * 6, {"wrong": True}),
        ],
    )
    def test_the_registration_must_agree(self, frames, monkeypatch, error, changes):
        atlas, closer = closed_by_objects(frames, monkeypatch, [error], None, **changes)
        before = bits(atlas)
        assert not closer.close_between(atlas, atlas.active)
        assert bits(atlas) == before and not closer.loops

    def test_the_odometry_refuses_them_before_a_registration(self, frames, tmp_path, monkeypatch):
        log = LoopLog(tmp_path / "loops.jsonl")
        away = [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        atlas, closer = closed_by_objects(frames, monkeypatch, [away], log)
        assert not closer.close_between(atlas, atlas.active)
        records = read_loop_log(tmp_path / "loops.jsonl")
        refused = [r for r in records if r["kind"] == "objects"]
        assert refused and all("odometry" in r["reason"] for r in refused)
        assert not [r for r in records if r["kind"] == "between" and "method" in r]


class TestWithin:
    def test_a_look_alike_that_the_odometry_rules_out_is_refused(
        self, frames, tmp_path, monkeypatch
    ):
        # Two views of one submap agree to the pixel, and the camera walked metres in between.
        same = Offset(np.eye(4), 50, 0.9, ResidualScales(0.02, 0.003), np.eye(6) * 1e8)
        measured(monkeypatch, lambda *_: same)
        away = np.eye(4)
        away[0, 3] = 4.0
        moved = [(f, away @ T if f.index >= 20 else T) for f, T in frames]
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(moved, log=log, max_keyframes=100)
        before = bits(atlas)
        assert not closer.close_within(atlas, Mapper(FEW)) and bits(atlas) == before
        records = read_loop_log(tmp_path / "loops.jsonl")
        taken = {(r["match"], r["query"]) for r in records if r["kind"] == "within"}
        refused = {(r["match"], r["query"]) for r in records if r["kind"] == "consistency"}
        far = {(match, query) for match, query in taken if query >= 20}
        assert far and far <= refused <= taken

    @pytest.mark.parametrize("iterations", [0, 10])
    def test_moved_keyframes_are_mapped_again_at_fixed_poses(self, frames, monkeypatch, iterations):
        """G, III.C: 10 mapping iterations a keyframe after a correction inside a submap."""
        truth = {frame.index: T for frame, T in frames}

        def true_offset(first, second):
            T = se3.inverse(truth[first.index]) @ truth[second.index]
            return Offset(T, 50, 0.9, ResidualScales(0.02, 0.003), np.eye(6) * 1e8)

        measured(monkeypatch, true_offset)
        options = ClosingOptions(mapping_iterations=iterations)
        atlas, closer, _ = closed(frames, options=options, max_keyframes=100)
        before = dict(atlas.keyframe_poses(0))
        corrected: dict[int, np.ndarray] = {}
        stepped: list[int] = []
        step = Mapper.step

        def counted(mapper, submap, keyframe, *arguments, **options):
            stepped.append(keyframe.index)
            corrected.setdefault(keyframe.index, keyframe.T_map_camera.copy())
            return step(mapper, submap, keyframe, *arguments, **options)

        monkeypatch.setattr(Mapper, "step", counted)
        assert closer.close_within(atlas, Mapper(FEW))
        after = atlas.keyframe_poses(0)
        moved = [index for index, T in before.items() if not np.array_equal(T, after[index])]
        assert len(moved) > 1
        assert sorted(stepped) == sorted(moved * iterations)
        assert all(np.array_equal(T, after[index]) for index, T in corrected.items())


class TestSettle:
    def test_pairs_that_overlap_are_measured_again(self, frames):
        atlas, closer, registrar = closed(frames)
        closer.close_between(atlas, atlas.active)
        held = len(closer.loops)
        atlas.store_active()
        registrar.asked.clear()
        closer.register_overlaps(atlas)
        # One small room: every submap sees what the others see.
        count = len(atlas)
        assert len(registrar.asked) == count * (count - 1) // 2 >= held
        assert len(closer.loops) >= held

    def test_submaps_of_different_parts_overlap_by_chance_and_are_not_registered(self, frames):
        atlas, closer, _ = closed(frames)
        atlas.store_active()
        loops = SubmapLoops(closer._parts, ClosingOptions(max_partners=8), lambda *_: None)
        last = atlas.active
        whole = loops.overlapping(atlas, set(), [range(last + 1)])
        divided = loops.overlapping(atlas, set(), [range(last), [last]])
        assert (0, last) in whole
        assert divided == [pair for pair in whole if last not in pair]

    @pytest.mark.parametrize("most", [0, 1, 8])
    def test_a_submap_is_measured_with_so_many_that_it_overlaps(self, frames, most):
        atlas, closer, _ = closed(frames)
        atlas.store_active()
        parts, last = closer._parts, atlas.active
        loops = SubmapLoops(parts, ClosingOptions(max_partners=most), lambda *_: None)
        held = {(0, last)}
        pairs = loops.overlapping(atlas, held, [range(len(atlas))])
        assert held <= set(pairs) and pairs == sorted(set(pairs))
        between = set(range(1, last))
        found = {number for pair in set(pairs) - held for number in pair}
        if most == 8:
            assert len(pairs) == (last + 1) * last // 2
        else:
            assert len(pairs) - 1 <= most * len(between) and found >= (between if most else set())

    @pytest.mark.parametrize(
        ("overlap", "confidence", "joins"),
        [(0.2, 0.99, True), (0.1, 0.99, False), (0.2, 1.0, False)],
    )
    def test_neighbours_that_were_refused_are_asked_again_for_less(
        self, frames, overlap, confidence, joins
    ):
        # They share less of their views than is asked of submaps that lie anywhere.
        options = ClosingOptions(drift_confidence=confidence)
        atlas, closer, registrar = closed(
            frames, options=options, nearby_changes={"overlap": overlap}
        )
        closer.close_between(atlas, atlas.active)
        atlas.store_active()
        registrar.changes["fails"] = True
        around = (0, atlas.active)
        closer._graph.loops = [loop for loop in closer.loops if (loop.first, loop.second) == around]
        assert closer.loops and closer.register_overlaps(atlas)
        neighbours = {(n, n + 1) for n in range(len(atlas) - 1)} if joins else set()
        assert {(loop.first, loop.second) for loop in closer.loops} == {around} | neighbours

    def test_without_a_loop_nothing_is_touched(self, frames, no_images):
        atlas, closer, registrar = closed(frames, {"fails": True})
        closer.close_between(atlas, atlas.active)
        before = bits(atlas)
        registrar.asked.clear()
        assert not closer.register_overlaps(atlas) and not registrar.asked and bits(atlas) == before


class TestLost:
    def test_of_places_that_look_alike_the_one_in_reach_is_tried(self, frames, monkeypatch):
        far = np.eye(4)
        far[0, 3] = 9.0
        atlas, closer, _ = closed([(f, far @ T if f.index >= 20 else T) for f, T in frames])
        lost, tried = frames[0][0], []
        monkeypatch.setattr(
            Relocaliser, "_align", lambda _, frame, keyframe, *rest: tried.append(keyframe.index)
        )

        def order(reach):
            tried.clear()
            part = tuple(range(len(atlas)))
            assert closer.relocaliser.find(lost, atlas, None, reach, part) is None
            return list(tried)

        anyhow = order(None)
        assert {index < 20 for index in anyhow[:2]} == {True, False}, "they look the same"
        for there in (np.eye(4), far):
            mine = [index < 20 for index in order(Reach(there, 2.0, 1.0))]
            assert mine and set(mine) == {there is not far}

    @pytest.mark.parametrize(
        ("reach_m", "closes"),
        [(0.5, False), (2.0, True), (None, True)],
        ids=["beyond", "within", "unknown"],
    )
    def test_a_loop_with_a_place_out_of_reach_is_none(self, frames, reach_m, closes):
        # The camera was 1 m beside the place of the last submap, which registration finds.
        (frame, T), *_ = frames[2:]
        again = (replace(frame, index=22, timestamp_s=22.0), T)
        atlas, closer, _ = closed([*frames, again], max_keyframes=4)
        last, beside = atlas.active, np.eye(4)
        beside[0, 3] = 1.0
        before = atlas.T_world_submap(last)
        closer._graph.odometry.links.pop()
        reach = None if reach_m is None else Reach(before @ beside, reach_m, 0.5)
        closer._graph.odometry.started_lost(atlas, None, reach)
        assert closer.parts(atlas)[-1] == (last,)
        assert closer.close_between(atlas, last) == closes
        assert (len(closer.parts(atlas)) == 1) == closes
        assert np.array_equal(atlas.T_world_submap(last), before) == (not closes)

    @pytest.mark.parametrize(
        ("shifts_m", "beyond_m", "closes"),
        [
            ([0.0], [], False),
            ([0.0, 0.1], [], True),
            ([0.0, 0.1, 1.0], [], False),
            ([0.0, 0.1], [1.5], False),
            ([0.0, 0.1], [9.0], True),
        ],
        ids=["one query", "two", "two places", "another that is near", "another far away"],
    )
    def test_only_a_place_like_no_other_joins_a_submap(
        self, frames, monkeypatch, shifts_m, beyond_m, closes
    ):
        def moved(metres):
            T = atlas.T_world_submap(last)
            T = se3.exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0])) @ T
            return PoseEdge.loop(0, last, T, np.eye(6) * 1e6)

        atlas, closer, _ = closed(frames)
        last = atlas.active
        closer._graph.odometry.links.pop()
        closer._graph.odometry.started_lost(
            atlas, None, Reach(atlas.T_world_submap(last), 2.0, 0.5)
        )
        edges = ImageEdges(
            len(shifts_m),
            list(map(moved, shifts_m)),
            list(map(moved, beyond_m)),
            list(range(len(shifts_m))),
            [np.eye(4)] * len(shifts_m),
        )
        monkeypatch.setattr(ImageLoops, "_edges", lambda *_: edges)
        assert closer.close_between(atlas, last) == closes
        assert (len(closer.parts(atlas)) == 1) == closes


class TestState:
    def test_a_restored_closer_continues_identically(self, frames, tmp_path):
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(frames, log=log)
        arrays, values = closer.state()
        values = json.loads(json.dumps(values))
        other_atlas, other, _ = closed(frames)
        other._graph.odometry.links, other._pending = [], []
        other.restore(arrays, values)
        assert closer.close_between(atlas, atlas.active)
        assert other.close_between(other_atlas, other_atlas.active)
        assert bits(atlas) == bits(other_atlas)
        mine, theirs = closer.state(), other.state()
        assert all(np.array_equal(mine[0][k], theirs[0][k]) for k in mine[0])

    def test_the_remembered_objects_are_part_of_it(self, frames):
        _, closer, _ = closed(frames)
        objects = ObjectHypotheses(SimpleNamespace(), 30)
        closer._parts = replace(closer._parts, objects=objects)
        one = Constellation(np.array([3]), np.ones((1, 3)), np.array([0.5]), np.eye(1))
        other = replace(one, class_ids=np.array([5]))
        objects._known = {2: (7, [one, other])}
        state = closer.state()
        objects._known = {}
        closer.restore(*state)
        size, found = objects._known[2]
        assert size == 7
        for before, after in zip((one, other), found, strict=True):
            assert all(np.array_equal(vars(before)[k], vars(after)[k]) for k in vars(one))

    def test_the_log_is_cut_back(self, frames, tmp_path):
        log = LoopLog(tmp_path / "loops.jsonl")
        atlas, closer, _ = closed(frames, log=log)
        state, size = closer.state(), log.size_bytes
        closer.close_between(atlas, atlas.active)
        assert log.size_bytes > size
        closer.restore(*state)
        assert (tmp_path / "loops.jsonl").stat().st_size == size


def test_a_described_view_keeps_its_rows_in_step(frames):
    atlas, _, _ = closed(frames)
    for number in range(len(atlas)):
        submap = atlas.submap(number)
        assert len(submap.descriptors) == len(submap.keyframes)
        assert np.allclose(np.linalg.norm(submap.descriptors, axis=1), 1.0, atol=1e-5)
    assert isinstance(atlas.submap(0).seeded_by, torch.Tensor)
