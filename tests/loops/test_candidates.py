"""Loop candidates on a closed path of places, two of which look the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops import candidates as candidates_module
from toolkit.slam.loops.candidates import CandidateFinder, DescribedKeyframe, LoopCandidate
from toolkit.slam.loops.options import CandidateOptions, LandmarkOptions

pytest.importorskip("faiss")

D = 32
PLACES = 30
THRESHOLD = 0.3
OPTIONS = CandidateOptions(
    search_every=1,
    min_gap_frames=50,
    min_gap_m=1.0,
    threshold="fixed",
)


def place_descriptors() -> np.ndarray:
    """[30, D] unit descriptors that change gradually; places 5 and 20 look the same."""
    generator = np.random.default_rng(0)
    ends = generator.normal(size=(7, D))
    steps = np.linspace(0, 6, PLACES)
    whole = np.minimum(steps.astype(int), 5)
    mixed = ends[whole] + (steps - whole)[:, None] * (ends[whole + 1] - ends[whole])
    mixed[20] = mixed[5] + 0.01
    return (mixed / np.linalg.norm(mixed, axis=1, keepdims=True)).astype(np.float32)


DESCRIPTORS = place_descriptors()


def keyframe(number: int, place: int | None = None) -> DescribedKeyframe:
    """Keyframe of the path: every fifth frame, 0.1 m apart, one class per place."""
    place = number % PLACES if place is None else place
    counts = np.full(PLACES + 1, 0)
    counts[PLACES], counts[place], counts[(place + 1) % PLACES] = 4000, 500, 300
    return DescribedKeyframe(5 * number, number // 10, 0.1 * number, DESCRIPTORS[place], counts)


def run_path(options: CandidateOptions = OPTIONS, count: int = 2 * PLACES):
    """The finder after the path, and the candidates of each keyframe."""
    finder = CandidateFinder(D, THRESHOLD, options)
    return finder, [finder.add(keyframe(n)) for n in range(count)]


def accepted(candidates: list[LoopCandidate]) -> list[int]:
    return [c.match // 5 for c in candidates if c.accepted]


def test_second_round_matches_the_first():
    _, found = run_path()
    assert not any(accepted(c) for c in found[: PLACES - 11] if c)
    for number in range(PLACES, 2 * PLACES):
        assert accepted(found[number])[0] == number - PLACES
        best = found[number][0]
        assert (best.query, best.query_submap) == (5 * number, number // 10)
        assert best.match_submap == (number - PLACES) // 10
        assert best.distance == pytest.approx(0.0, abs=1e-3)
        assert best.landmark_distance == pytest.approx(0.0, abs=1e-6)


def test_landmarks_rank_candidates_with_similar_descriptors():
    finder, _ = run_path(OPTIONS, PLACES + 20)
    # Place 20 is revisited with the descriptor of place 5.
    again = finder.add(replace(keyframe(PLACES + 20), descriptor=DESCRIPTORS[5]))
    assert accepted(again)[0] == 20
    twin = next(c for c in again if c.match // 5 == 5)
    assert twin.accepted
    assert twin.distance < again[0].distance
    assert twin.landmark_distance > again[0].landmark_distance


def test_best_candidate_of_each_submap_comes_first():
    finder = CandidateFinder(D, THRESHOLD, replace(OPTIONS, kept=2, min_gap_frames=1))
    aside = np.eye(D, dtype=np.float32)[0]
    nothing = np.zeros(0, np.int64)

    def view(number: int, submap: int, offset: float) -> DescribedKeyframe:
        descriptor = DESCRIPTORS[0] + np.float32(offset) * aside
        unit = descriptor / np.linalg.norm(descriptor)
        return DescribedKeyframe(5 * number, submap, 2.0 * number, unit, nothing)

    # Four views of the similar place are slightly nearer than the view of the true place.
    for number, offset in enumerate([0.1, 0.01, 0.02, 0.03, 0.04]):
        finder.add(view(number, min(number, 1), offset))
    found = finder.add(view(9, 2, 0.0))
    assert [c.match for c in found if c.accepted] == [5, 0]
    assert found[2].match == 10 and "2 are kept" in found[2].reason


@pytest.mark.parametrize("weighting", ["sqrt", "linear", "inverse"])
def test_every_weighting_distinguishes_similar_places(weighting):
    finder = CandidateFinder(D, THRESHOLD, OPTIONS, LandmarkOptions(weighting))
    found = [finder.add(keyframe(n)) for n in range(PLACES + 21)]
    assert accepted(found[-1])[0] == 20


def test_printed_weights_are_those_of_each_keyframes_submap():
    """The same view is at distance 0 until one submap has grown."""
    small, large = np.full(PLACES + 1, 100), np.full(PLACES + 1, 100)
    large[3] = 5000
    for second, alike in ((small, True), (large, False)):
        finder = CandidateFinder(D, THRESHOLD, OPTIONS, LandmarkOptions("paper"))
        for number in range(PLACES + 4):
            counts = small if number < PLACES else second
            view = replace(keyframe(number), submap=number // PLACES, submap_counts=counts)
            found = finder.add(view)
        match = next(c for c in found if c.match == 5 * 3)
        assert match.accepted
        assert (match.landmark_distance == 0.0) is alike
        restored = CandidateFinder(D, THRESHOLD, OPTIONS, LandmarkOptions("paper"))
        restored.restore(finder.state())
        assert restored.search(PLACES + 3) == found


def test_every_considered_keyframe_is_returned_once_with_a_reason():
    options = replace(OPTIONS, considered=7, kept=2, distance=1.0)
    _, found = run_path(options)
    for candidates in found[PLACES:]:
        assert len(candidates) == len({c.match for c in candidates}) == 7
        assert all(c.reason for c in candidates)
        assert len(accepted(candidates)) <= 2
        assert not any(c.accepted for c in candidates[len(accepted(candidates)) :])
    last = found[-1]
    assert "rank 1 of" in last[0].reason
    surplus = [c for c in last if "2 are kept" in c.reason]
    assert surplus and all(not c.accepted and c.distance < 1.0 for c in surplus)


def test_candidates_beyond_the_threshold_are_rejected():
    _, found = run_path()
    for candidates in found:
        for c in candidates:
            assert c.accepted <= (c.distance < THRESHOLD)
            if "descriptor distance" in c.reason:
                assert c.distance >= THRESHOLD
            assert c.cosine == pytest.approx(1 - c.distance**2 / 2, abs=1e-6)


def test_neighbouring_keyframes_are_not_candidates():
    _, found = run_path()
    for candidates in found:
        for c in candidates:
            assert c.query - c.match >= 50
            assert 0.02 * (c.query - c.match) >= 1.0 - 1e-9


def test_stationary_camera_has_no_candidates():
    finder = CandidateFinder(D, THRESHOLD, OPTIONS)
    for number in range(40):
        still = replace(keyframe(number, place=3), travelled_m=0.01 * number)
        assert finder.add(still) == []


def test_search_interval():
    _, found = run_path(replace(OPTIONS, search_every=6))
    searched = [n for n, candidates in enumerate(found) if candidates]
    assert searched == [n for n in range(10, 2 * PLACES) if (n + 1) % 6 == 0]


def test_adaptive_threshold_follows_distances_to_neighbours(monkeypatch):
    # The quantile lies between two of the nine distances, so that rounding has no effect.
    monkeypatch.setattr(candidates_module, "_ADAPTIVE_QUANTILE", 0.4)
    monkeypatch.setattr(candidates_module, "_ADAPTIVE_LIMIT", 10.0)
    adaptive = replace(OPTIONS, threshold="adaptive")
    finder, found = run_path(adaptive)
    number = 2 * PLACES - 1
    own = [np.linalg.norm(DESCRIPTORS[29] - DESCRIPTORS[p]) for p in range(20, 29)]
    limit = float(np.quantile(own, 0.4))
    assert {c.distance >= limit for c in found[number]} == {False, True}
    for c in found[number]:
        assert ("descriptor distance" in c.reason) == (c.distance >= limit)
    monkeypatch.setattr(candidates_module, "_ADAPTIVE_LIMIT", 0.1)
    _, limited = run_path(adaptive)
    reasons = [c.reason for c in limited[number] if not c.accepted]
    assert any(f"not below {0.1 * THRESHOLD:.3f}" in reason for reason in reasons)
    assert len(finder) == 2 * PLACES


def test_distance_option_replaces_the_encoder_threshold():
    _, found = run_path(replace(OPTIONS, distance=1e-3))
    assert accepted(found[-1]) == [PLACES - 1]


def test_without_classes_candidates_are_ranked_by_descriptor():
    finder = CandidateFinder(D, THRESHOLD, OPTIONS)
    found = []
    for n in range(2 * PLACES):
        found = finder.add(replace(keyframe(n), class_counts=np.zeros(0, np.int64)))
    taken = [c for c in found if c.accepted]
    assert taken[0].match // 5 == PLACES - 1
    assert all(c.landmark_distance is None for c in found)
    assert [c.distance for c in taken] == sorted(c.distance for c in taken)


def test_by_rank_the_nearest_are_accepted_whatever_their_distance():
    by_rank = replace(OPTIONS, threshold="rank")
    _, found = run_path(by_rank)
    for candidates in filter(None, found):
        taken = [c for c in candidates if c.accepted]
        assert len(taken) == min(by_rank.kept, len(candidates))
        assert min(c.distance for c in candidates) == taken[0].distance
    assert any(c.accepted and c.distance > THRESHOLD for cs in found for c in cs)


def test_by_rank_a_distance_still_limits():
    by_rank = replace(OPTIONS, threshold="rank", distance=1e-3)
    assert accepted(run_path(by_rank)[1][-1]) == [PLACES - 1]


def test_by_rank_descriptors_precede_landmarks():
    by_rank = replace(OPTIONS, threshold="rank")
    finder, _ = run_path(by_rank, PLACES + 20)
    again = finder.add(replace(keyframe(PLACES + 20), descriptor=DESCRIPTORS[5]))
    assert accepted(again)[0] == 5


@pytest.mark.parametrize("at", [0, 1, 37])
def test_restored_finder_continues_identically(at):
    finder = CandidateFinder(D, THRESHOLD, OPTIONS)
    for n in range(at):
        finder.add(keyframe(n))
    restored = CandidateFinder(D, THRESHOLD, OPTIONS)
    restored.restore(finder.state())
    for n in range(at, 2 * PLACES):
        assert restored.add(keyframe(n)) == finder.add(keyframe(n))
    state, other = finder.state(), restored.state()
    assert all(state[name].tobytes() == other[name].tobytes() for name in state)


def test_the_threshold_of_a_describer_separates_similar_views():
    describer = ViewDescriber(BuiltinEncoder())
    candidates = CandidateOptions(
        search_every=1, min_gap_frames=1, min_gap_m=0.0, threshold="fixed"
    )
    landmarks = LandmarkOptions(weighting="linear")
    finder = CandidateFinder(describer.dimensions, describer.threshold, candidates, landmarks)
    here = np.zeros(384, np.float32)
    here[0] = 1.0
    angle = 1.1 * describer.threshold
    there = np.zeros(384, np.float32)
    there[:2] = np.cos(angle), np.sin(angle)
    nothing = np.zeros(0, np.int64)
    finder.add(DescribedKeyframe(0, 0, 0.0, here, nothing))
    assert [c.accepted for c in finder.add(DescribedKeyframe(1, 0, 1.0, here, nothing))] == [True]
    found = finder.add(DescribedKeyframe(2, 0, 2.0, there, nothing))
    assert [c.accepted for c in found] == [False, False]
