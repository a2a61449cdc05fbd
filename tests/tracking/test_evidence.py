"""Evidence for poses: which are doubtful, and which are better than others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracked_room import Room, small_motion

from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.evidence import doubt_reason, is_clear, quality
from toolkit.slam.tracking.result import Health
from toolkit.splatting.alignment.similarity import Similarity
from toolkit.splatting.gaussians.cloud import GaussianCloud

RIGHT = Similarity(0.95, 0.85, 60, 0.8, 0.95)


def test_good_evidence_is_clear_and_leaves_no_doubt():
    assert is_clear(RIGHT) and not doubt_reason(RIGHT)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"correlation": 0.4}, "correlate by only 0.40"),
        ({"agreeing": 0.6}, "only 60 % of the depth agrees"),
        ({"covered": 0.1}, "covers only 10 %"),
    ],
)
def test_each_contradiction_is_a_doubt_with_its_reason(change: dict[str, float], reason: str):
    doubted = replace(RIGHT, **change)
    assert reason in doubt_reason(doubted)
    assert not is_clear(doubted)
    assert quality(doubted) < quality(RIGHT)


def test_without_texture_depth_decides_and_nothing_is_clear():
    blank = replace(RIGHT, correlation=float("nan"), low_correlation=float("nan"), blocks=0)
    assert not doubt_reason(blank) and not is_clear(blank)
    assert 0.0 < quality(blank) < quality(RIGHT)


def test_a_true_pose_has_the_better_evidence(room: Room, gaussians: GaussianCloud):
    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    true = room.T_map_camera[2]
    here, beside = (
        tracker.locate(room.frames[2], gaussians, T, search=False)
        for T in (true, true @ small_motion(3, metres=0.5, degrees=50.0))
    )
    assert quality(here.similarity) > quality(beside.similarity) + 0.2


def test_a_frame_of_another_texture_is_doubtful(room: Room, gaussians: GaussianCloud):
    """Its depth fits as that of the room does; only its colours contradict the pose."""
    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    assert tracker.track(room.frames[1], gaussians).health is Health.GOOD
    before = tracker.motion.last()
    painted = np.random.default_rng(0).random(room.frames[2].rgb.shape, np.float32)
    result = tracker.track(replace(room.frames[2], rgb=painted), gaussians)
    assert result.health is not Health.GOOD and result.reason
    assert np.array_equal(tracker.motion.last(), before)
