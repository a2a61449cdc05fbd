"""Loop figures on a camera that walks a circle twice, where every loop is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.frustum import observed_points
from toolkit.runs.evaluation.loops import (
    LoopTruthOptions,
    TrueMatches,
    TrueViews,
    loop_convention,
    loop_definitions,
    loop_metrics,
    score_loops,
    true_intervals,
)

CAMERA = Camera(30.0, 30.0, 31.5, 23.5, 64, 48)
ROUND = 100
RADIUS_M = 3.0


def circling(second_round_rad: float = 0.0) -> TrueViews:
    """Two rounds of 100 frames, looking outwards at a wall 2 m off; then turned by an angle."""
    poses = []
    for frame in range(2 * ROUND):
        angle = 2 * math.pi * frame / ROUND
        turn = np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0])
        T = se3.exp(turn)
        T[:3, 3] = T[:3, :3] @ [0.0, 0.0, RADIUS_M]
        if frame >= ROUND:
            T = T @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, second_round_rad, 0.0]))
        poses.append(T)
    points = observed_points(CAMERA, np.full((48, 64), 2.0, np.float32), 60)
    count = 2 * ROUND
    return TrueViews(
        CAMERA, np.array(poses), np.repeat(points[None], count, 0), np.full(count, 3.0)
    )


# A frame of the circle is 19 cm; half a metre and an interval of two frames leave no doubt.
OPTIONS = LoopTruthOptions(interval=2, min_gap_frames=30, min_gap_m=1.0)


def test_each_interval_of_the_second_round_meets_the_first():
    truth = true_intervals(circling(), OPTIONS)
    later, earlier = np.nonzero(truth)
    apart = later * 2 - earlier * 2
    assert (truth.sum(axis=1)[50:] >= 1).all()
    assert truth[np.arange(50, 100), np.arange(50)].all()
    assert (np.abs(apart - ROUND) <= 2).all()
    assert not truth[:49].any()


def test_back_to_back_is_a_loop_by_position_alone():
    views = circling(math.pi)
    assert not true_intervals(views, OPTIONS).any()
    alone = replace(OPTIONS, min_overlap=0.0)
    np.testing.assert_array_equal(true_intervals(views, alone), true_intervals(circling(), alone))


def test_overlap_is_the_smaller_of_both_directions():
    views = circling()
    deep = views.points_m.copy()
    deep[150] *= 10.0  # this view saw far beyond what the other's frustum holds
    seen = replace(views, points_m=deep, far_m=np.where(np.arange(200) == 150, 30.0, 3.0))
    assert views.overlaps(150, np.array([50]))[0] == pytest.approx(1.0)
    assert seen.overlaps(150, np.array([50]))[0] == 0.0
    assert seen.overlaps(50, np.array([150, 51]))[0] == 0.0


def test_the_gap_asks_for_frames_and_metres():
    views = circling()
    assert not true_intervals(views, replace(OPTIONS, min_gap_frames=110)).any()
    assert not true_intervals(views, replace(OPTIONS, min_gap_m=22.0)).any()
    short = true_intervals(
        views, replace(OPTIONS, min_gap_frames=1, min_gap_m=0.0, max_distance_m=0.7)
    )
    assert short[10, 9]


def test_pairs_within_the_gap_do_not_count_against_an_interval():
    views = circling()
    still = replace(views, T_world_camera=np.repeat(views.T_world_camera[:1], 200, axis=0))
    options = LoopTruthOptions(min_gap_frames=5, min_gap_m=0.0, interval=2)
    truth = true_intervals(still, options)
    # Of frames 4, 5 and 0, 1 only the pair (5, 0) is beyond the gap; of 2, 3 and 0, 1 none.
    assert truth[2, 0]
    assert not truth[1, 0]


def test_every_admissible_pair_of_two_intervals_must_be_close():
    # Six frames are 0.95 m of the circle: no two such intervals are within half a metre.
    assert not true_intervals(circling(), replace(OPTIONS, interval=6)).any()
    wide = replace(OPTIONS, interval=6, max_distance_m=1.2)
    assert true_intervals(circling(), wide).any()


def test_figures_count_searched_keyframes_only():
    searched = [20, 120, 140, 160, 180]
    accepted = [(120, 20), (120, 70), (140, 41), (180, 10)]
    score = score_loops(circling(), searched, accepted, OPTIONS)
    assert (score.accepted, score.correct) == (4, 2)
    assert (score.with_loop, score.found) == (4, 2)
    assert score.precision == 0.5
    assert score.recall == 0.5
    assert score.f1 == 0.5
    assert score.found_intervals == 2
    assert score.recall_of_all == 2 / score.true_intervals
    assert score.true_intervals == 50


def test_a_detector_that_finds_all_scores_one_whatever_its_rate():
    for every in (1, 5, 20):
        searched = range(0, 200, every)
        accepted = [(q, q - ROUND) for q in searched if q >= ROUND]
        score = score_loops(circling(), searched, accepted, OPTIONS)
        assert score.precision == score.recall == score.f1 == 1.0
        assert score.recall_of_all <= 1.0


def test_nothing_accepted_has_no_precision_but_a_recall_of_zero():
    score = score_loops(circling(), [150], [], OPTIONS)
    assert score.precision is None
    assert (score.recall, score.f1) == (0.0, 0.0)
    none = score_loops(circling(), [10], [], OPTIONS)
    assert (none.precision, none.recall, none.f1) == (None, None, None)


def test_frames_without_a_true_pose_take_no_part():
    views = circling()
    poses = views.T_world_camera.copy()
    poses[120:122] = np.nan
    score = score_loops(replace(views, T_world_camera=poses), [120], [(120, 20)], OPTIONS)
    assert (score.correct, score.with_loop) == (0, 0)


def test_metrics_are_percent_and_name_their_convention():
    metrics = loop_metrics(circling(math.pi), [140, 160], [(140, 40)], OPTIONS)
    assert metrics["overlap"]["precision_percent"] == 0.0
    assert metrics["overlap"]["recall_percent"] is None
    assert metrics["position"]["precision_percent"] == 100.0
    assert metrics["position"]["recall_percent"] == 50.0
    # In ten frames this camera moves farther than half a metre.
    assert metrics["intervals_position"]["precision_percent"] == 0.0
    assert metrics["intervals_position"]["recall_percent"] is None
    assert metrics["position"]["f1_percent"] == pytest.approx(200 / 3)
    assert metrics["accepted"] == 1
    definitions = loop_definitions(OPTIONS)
    overlap, position = (loop_convention(definitions[name]) for name in ("overlap", "position"))
    assert "30 %" in overlap and "%" not in position
    assert "30 frames, 1 m of path" in overlap


def test_frames_outside_the_sequence_are_refused():
    with pytest.raises(ValueError, match=r"0\.\.199"):
        score_loops(circling(), [200], [], OPTIONS)
    with pytest.raises(ValueError, match="same frames"):
        TrueViews(CAMERA, np.zeros((3, 4, 4)), np.zeros((2, 5, 3)), np.zeros(3))


@pytest.mark.parametrize("options", [OPTIONS, replace(OPTIONS, min_overlap=0.0)])
def test_single_frames_have_the_loops_of_the_whole(options):
    views = circling()
    alone = replace(options, interval=1)
    whole, matches = true_intervals(views, alone), TrueMatches(views, alone)
    for frame in (0, 99, 130, 180):
        np.testing.assert_array_equal(matches.of(frame), whole[frame])
    assert matches.contain((130, 30)) == whole[130, 30]
