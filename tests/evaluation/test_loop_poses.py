"""Pose errors of loop edges."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.runs.evaluation.loop_poses import edge_errors, edge_metrics
from toolkit.runs.evaluation.options import TruthErrorOptions

TIMES = 0.1 * np.arange(20)
TURN_RAD_S = 2.0


def turning_there_and_back():
    """A camera that turns right for 10 frames, and back."""
    angles = TURN_RAD_S * np.r_[TIMES[:10], TIMES[9::-1]]
    return np.array([se3.exp(np.array([0, 0, 0, 0, a, 0])) for a in angles])


def edge(T, match, query, error=(0, 0, 0, 0, 0, 0)):
    measured = se3.inverse(T[match]) @ T[query] @ se3.exp(np.array(error, dtype=float))
    return {"match": match, "query": query, "T_match_query": measured.ravel().tolist()}


def errors(edges, T=None, **own):
    T = turning_there_and_back() if T is None else T
    return edge_errors(edges, T, TIMES, TruthErrorOptions(**own))


def test_the_error_is_that_of_the_relative_pose():
    T = turning_there_and_back()
    (found,) = errors([edge(T, 3, 15, (0.03, 0, 0.04, 0, 0, np.radians(1.5)))])
    assert (found.match, found.query) == (3, 15)
    assert found.metres == pytest.approx(0.05, rel=1e-3)
    assert found.degrees == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("error", "right"),
    [
        ((0.049, 0, 0, 0, 0, 0), True),
        ((0.051, 0, 0, 0, 0, 0), False),
        ((0, 0, 0, 0, 0, 0.034), True),
        ((0, 0, 0, 0, 0, 0.036), False),
    ],
)
def test_an_edge_is_right_within_both_bounds(error, right):
    assert errors([edge(turning_there_and_back(), 3, 15, error)])[0].right == right


def test_the_error_of_the_truth_is_allowed_in_addition():
    edges = [edge(turning_there_and_back(), 3, 15, (0.06, 0, 0, 0, 0, 0.05))]
    assert not errors(edges)[0].right
    assert not errors(edges, truth_error_m=0.02)[0].right
    assert errors(edges, truth_error_m=0.02, truth_error_deg=1.0)[0].right


def test_late_truth_matters_between_turns_in_opposite_directions():
    T = turning_there_and_back()
    # The images show what the camera saw 15 ms later: 3.4 degrees between opposite turns.
    shift = se3.exp(np.array([0, 0, 0, 0, 0.015 * TURN_RAD_S, 0]))
    late = [{"match": 3, "query": 15} for _ in range(2)]
    late[1]["query"] = 7
    for record, sign in zip(late, (-1, 1), strict=True):
        second = T[record["query"]] @ (shift if sign > 0 else se3.inverse(shift))
        pose = se3.inverse(T[3] @ shift) @ second
        record["T_match_query"] = pose.ravel().tolist()
    opposite, same = errors(late)
    assert opposite.degrees == pytest.approx(np.degrees(2 * 0.015 * TURN_RAD_S), rel=1e-6)
    assert not opposite.right and same.degrees < 1e-6
    opposite, same = errors(late, truth_error_s=0.015)
    assert opposite.right and opposite.allowed_deg == pytest.approx(2.0 + opposite.degrees)
    # Two frames of one turn are shifted alike.
    assert same.allowed_deg == pytest.approx(2.0, abs=1e-6)


def test_frames_without_truth_do_not_count():
    T = turning_there_and_back()
    edges = [edge(T, 3, 15), edge(T, 3, 16)]
    T[16] = np.nan
    found = errors(edges, T)
    assert [e.query for e in found] == [15]


def test_metrics():
    T = turning_there_and_back()
    found = errors([edge(T, 3, q, (0.01 * q, 0, 0, 0, 0, 0)) for q in (1, 2, 9)])
    metrics = edge_metrics(found)
    assert metrics["count"] == 3 and metrics["right"] == 2
    assert metrics["right_percent"] == pytest.approx(200 / 3)
    assert metrics["error_median_cm"] == pytest.approx(2.0)
    assert metrics["error_max_cm"] == pytest.approx(9.0)
    assert metrics["error_max_deg"] == pytest.approx(0.0, abs=1e-5)


def test_no_edges_have_no_errors():
    metrics = edge_metrics([])
    assert metrics["count"] == 0 and metrics["right_percent"] is None
    assert metrics["error_max_cm"] is None
