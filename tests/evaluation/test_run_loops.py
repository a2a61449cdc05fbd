"""Figures of loops from a run's log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.runs.evaluation import run_loops
from toolkit.runs.evaluation.loops import LoopTruthOptions
from toolkit.runs.evaluation.options import TruthErrorOptions
from toolkit.runs.evaluation.run_loops import run_loop_metrics

GAP = LoopTruthOptions(min_gap_frames=6, min_gap_m=0.0)


class There:
    """A walk and the same walk again, as a data set."""

    def __init__(self, truth=True):
        frames, path = tiny_room(6, 64, 48)
        again = [replace(f, index=6 + f.index, timestamp_s=6.0 + f.timestamp_s) for f in frames]
        self.frames = [*frames, *again]
        times = np.array([f.timestamp_s for f in self.frames])
        poses = np.concatenate([path.T_world_camera] * 2)
        self.ground_truth = Trajectory(times, poses) if truth else None
        self.camera = frames[0].camera

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]


def found(query, match, kind="verified", accepted=True, apart_m=0.1):
    pair = {"query": query, "match": match, "apart_m": apart_m}
    return {"kind": kind, "accepted": accepted} | pair


SEARCHES = [{"kind": "search", "query": q, "considered": 3} for q in (5, 8, 10)]


def test_verified_and_suspected_loops_are_counted_separately():
    records = [
        *SEARCHES,
        found(8, 2, "candidate"),
        found(10, 4, "candidate"),
        found(10, 4),
        found(8, 2, accepted=False),
    ]
    metrics = run_loop_metrics(records, There(), GAP)
    assert metrics["verified"]["overlap"]["precision_percent"] == 100.0
    assert metrics["verified"]["overlap"]["recall_percent"] == pytest.approx(50.0)
    assert metrics["suspected"]["overlap"]["recall_percent"] == pytest.approx(100.0)
    assert metrics["searched"] == 3


def test_a_loop_within_the_gap_is_none():
    metrics = run_loop_metrics([*SEARCHES, found(8, 7)], There(), GAP)
    assert metrics["verified"]["overlap"]["precision_percent"] == 0.0


def test_the_same_things_seen_from_elsewhere_are_no_claim():
    metrics = run_loop_metrics([*SEARCHES, found(10, 4, apart_m=0.8)], There(), GAP)
    verified = metrics["verified"]
    assert verified["accepted"] == 0 and verified["overlap"]["precision_percent"] is None


@pytest.mark.parametrize("kind", ["consistency", "retracted"])
def test_a_pair_whose_edge_was_taken_back_is_no_claim(kind):
    edges = [{"first": 0, "second": n} for n in (3, 4)]
    taken_back = {"kind": kind, "accepted": False, "reason": "contradicts"} | edges[0]
    records = [*SEARCHES, found(8, 2) | edges[0], found(10, 4) | edges[1], taken_back]
    metrics = run_loop_metrics(records, There(), GAP)
    assert metrics["verified"]["accepted"] == 1
    assert metrics["verified"]["overlap"]["recall_percent"] == pytest.approx(50.0)


def test_a_pair_of_one_submap_that_the_odometry_rules_out_is_no_claim():
    refused = {"kind": "consistency", "match": 2, "query": 8, "accepted": False, "reason": "far"}
    records = [*SEARCHES, found(8, 2, "within"), found(10, 4, "within"), refused]
    assert run_loop_metrics(records, There(), GAP)["verified"]["accepted"] == 1


def test_nothing_is_said_without_searches_or_truth():
    assert run_loop_metrics([found(8, 2)], There(), GAP) == {}
    assert run_loop_metrics(SEARCHES, There(truth=False), GAP) == {}


def posed(query, match, error_m, **values):
    truth = There().ground_truth.T_world_camera
    T = se3.inverse(truth[match]) @ truth[query] @ se3.exp(np.array([error_m, 0, 0, 0, 0, 0]))
    return found(query, match, **values) | {"T_match_query": T.ravel().tolist()}


def test_the_pose_of_an_edge_is_compared_with_the_truth():
    records = [*SEARCHES, posed(8, 2, 0.01), posed(10, 4, 0.06), posed(9, 3, 0.5, accepted=False)]
    metrics = run_loop_metrics(records, There(), GAP)
    assert metrics["edges"]["count"] == 2 and metrics["edges"]["right"] == 1
    assert metrics["edges"]["error_max_cm"] == pytest.approx(6.0)
    own = TruthErrorOptions(truth_error_m=0.02)
    assert run_loop_metrics(records, There(), GAP, own)["edges"]["right"] == 2


def test_a_relocalisation_that_connects_a_submap_is_an_edge():
    edge = {"kind": "found", "first": 0, "second": 1}
    record = posed(8, 2, 0.03) | edge
    del record["accepted"]
    assert run_loop_metrics([*SEARCHES, record], There(), GAP)["edges"]["count"] == 1
    removed = edge | {"kind": "retracted", "accepted": False, "reason": "contradicts"}
    assert run_loop_metrics([*SEARCHES, record, removed], There(), GAP)["edges"]["count"] == 0


def test_a_long_sequence_is_evaluated_on_some_frames(monkeypatch):
    records = [*SEARCHES, found(10, 4), found(8, 2, "candidate"), found(10, 1, "candidate")]
    every = run_loop_metrics(records, There(), GAP)
    monkeypatch.setattr(run_loops, "_MAX_FRAMES", 10)
    monkeypatch.setattr(run_loops, "_SAMPLED", 3)
    some = run_loop_metrics(records, There(), GAP)
    assert every["frames_compared"] == 12
    assert some["frames_compared"] == len({0, 6, 11, 5, 8, 10, 4, 2, 1})
    for group in ("verified", "suspected"):
        for name in ("overlap", "position"):
            expected = dict(every[group][name], recall_of_all_percent=None)
            assert some[group][name] == expected
        assert "intervals" not in some[group] and "intervals" in every[group]


def test_of_many_searches_some_are_evaluated(monkeypatch):
    monkeypatch.setattr(run_loops, "_MAX_FRAMES", 10)
    monkeypatch.setattr(run_loops, "_SAMPLED_SEARCHES", 2)
    metrics = run_loop_metrics([*SEARCHES, found(8, 2)], There(), GAP)
    assert metrics["searched"] == 3
    assert metrics["verified"]["overlap"]["searched_with_truth"] == 1  # 5 and 10, not 8
    assert metrics["verified"]["overlap"]["precision_percent"] == 100.0


def test_the_speed_at_the_edges_of_a_long_sequence_is_known(monkeypatch):
    record = found(10, 4, "found") | {"T_match_query": np.eye(4).reshape(-1).tolist()}
    own = TruthErrorOptions(truth_error_s=0.1)
    every = run_loop_metrics([*SEARCHES, record], There(), GAP, own)["edges"]
    monkeypatch.setattr(run_loops, "_MAX_FRAMES", 10)
    monkeypatch.setattr(run_loops, "_SAMPLED", 2)
    assert run_loop_metrics([*SEARCHES, record], There(), GAP, own)["edges"] == every
