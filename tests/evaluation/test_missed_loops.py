"""Missed loops: searched keyframes with a true loop that led to no verified edge."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry.camera import Camera
from toolkit.runs.evaluation.loops import LoopTruthOptions, TrueViews
from toolkit.runs.evaluation.missed_loops import missed_loops

CAMERA = Camera(20.0, 20.0, 9.5, 7.5, 20, 16)
GAP = LoopTruthOptions(min_gap_frames=4, min_gap_m=0.5)


@pytest.fixture
def views():
    """A camera that moves 2 m sideways in five frames and jumps back to the first place."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:5, 0, 3] = 0.5 * np.arange(5)
    points = np.array([[-0.4, 0.0, 2.0], [0.4, 0.1, 2.0], [0.0, -0.3, 2.0]])
    return TrueViews(CAMERA, poses, np.tile(points, (6, 1, 1)), np.full(6, 3.0))


SEARCH = [{"kind": "search", "query": q, "considered": 1} for q in (4, 5)]
CANDIDATE = {
    "kind": "candidate",
    "query": 5,
    "match": 0,
    "query_submap": 1,
    "match_submap": 0,
    "accepted": True,
    "reason": "rank 1",
}


def images(accepted: bool, reason: str = "") -> dict:
    pair = {"first": 0, "second": 1, "query": 5, "match": 0, "apart_m": 0.0}
    return {"kind": "images", **pair, "accepted": accepted, "reason": reason}


def test_a_loop_with_a_verified_edge_is_not_missed(views):
    assert missed_loops([*SEARCH, CANDIDATE, images(True)], views, GAP) == []


def test_only_searched_keyframes_with_a_true_loop_are_reported(views):
    (missed,) = missed_loops(SEARCH, views, GAP)
    assert (missed.query, missed.match, missed.overlap) == (5, 0, 1.0)
    assert missed.reason == "no keyframe was considered"
    assert missed_loops(SEARCH[:1], views, GAP) == []


@pytest.mark.parametrize(
    ("records", "reason"),
    [
        ([CANDIDATE | {"accepted": False, "reason": "too far"}], "with frame 0: too far"),
        ([CANDIDATE], "frames 0: images do not match"),
        ([CANDIDATE, images(False, "few matches")], "with frame 0: few matches"),
        (
            [CANDIDATE, {"kind": "between", "first": 0, "second": 1, "reason": "3 % overlap"}],
            "submaps 0 and 1: 3 % overlap",
        ),
    ],
)
def test_the_last_result_is_the_reason(views, records, reason):
    (missed,) = missed_loops([*SEARCH, *records], views, GAP)
    assert missed.reason == reason


def test_an_edge_that_was_removed_is_missed(views):
    removed = {"kind": "retracted", "first": 0, "second": 1, "reason": "contradicts"}
    (missed,) = missed_loops([*SEARCH, CANDIDATE, images(True), removed], views, GAP)
    assert missed.reason.endswith("contradicts")
