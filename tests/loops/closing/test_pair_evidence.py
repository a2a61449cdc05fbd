"""Edges that alignment confirms in both directions, and the images contradict."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.slam.loops.closing import pair_matching
from toolkit.slam.loops.closing.log_entries import pair_values
from toolkit.slam.loops.closing.pair_matching import PairMatcher, VerifiedPair
from toolkit.slam.tracking.rolling_shutter import as_exposed


@pytest.fixture(scope="module")
def walk():
    """Frames of a turn by 1.35 degrees and 1.6 cm a frame."""
    return tiny_room(32, 160, 120)


def keyframe(walk, colour: int, depth: int, blur: float = 0.0) -> Keyframe:
    """The colour of one frame with the depth of another one."""
    frame = replace(walk[0][colour], depth_m=walk[0][depth].depth_m)
    if blur:
        frame = replace(frame, rgb=cv2.GaussianBlur(frame.rgb, (0, 0), blur))
    return Keyframe.from_frame(frame, np.eye(4))


def verified_without_comparison(first: Keyframe, second: Keyframe) -> VerifiedPair:
    """The pair, whatever the correlation of its images."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pair_matching, "_contradiction", lambda evidence: "")
        return verified(first, second)


def verified(first: Keyframe, second: Keyframe) -> VerifiedPair:
    matcher = PairMatcher()
    rough = matcher.rough(first, second)
    assert rough is not None
    return matcher.verified(first, second, rough)


def error_deg(walk, pair: VerifiedPair, match: int, query: int) -> float:
    T = walk[1].T_world_camera
    true = se3.inverse(T[match]) @ T[query]
    error = se3.inverse(true) @ pair.offset.T_first_second
    return float(np.degrees(se3.rotation_angle_rad(error[:3, :3])))


@pytest.mark.parametrize(("match", "query"), [(0, 4), (0, 8), (20, 24)])
def test_a_correct_pair_is_accepted(walk, match, query):
    pair = verified(keyframe(walk, match, match), keyframe(walk, query, query))
    assert not pair.reason and error_deg(walk, pair, match, query) < 0.05
    assert pair.evidence.correlation > 0.98 and abs(pair.evidence.lost_correlation) < 0.01
    values = pair_values(pair)
    assert values["correlation"] == pair.evidence.correlation


@pytest.mark.parametrize(("match", "query", "late"), [(0, 4, 1), (0, 4, 2), (20, 24, 2)])
def test_depth_of_another_time_pulls_both_directions_to_a_wrong_pose(walk, match, query, late):
    first, second = keyframe(walk, match, match), keyframe(walk, query, query + late)
    confirmed = verified_without_comparison(first, second)
    assert not confirmed.reason
    assert error_deg(walk, confirmed, match, query) > 1.0
    pair = verified(first, second)
    assert "correlate" in pair.reason


def test_without_tests_the_forward_alignment_is_the_result(walk, monkeypatch):
    monkeypatch.setattr(pair_matching, "_MAX_DISAGREEMENT_M", 1e-9)
    first, second = keyframe(walk, 0, 0), keyframe(walk, 4, 5)
    matcher = PairMatcher(tests=False)
    pair = matcher.verified(first, second, matcher.rough(first, second))
    assert not pair.reason and pair.evidence is None
    assert verified(first, second).reason


def test_the_reason_contains_both_correlations(walk):
    first, second = keyframe(walk, 20, 20), keyframe(walk, 24, 25)
    reason = verified(first, second).reason
    before, after = (float(number) for number in re.findall(r"by (\d\.\d+)", reason))
    assert before > after + pair_matching._MAX_LOST_CORRELATION


def test_blur_of_one_image_is_no_contradiction(walk):
    pair = verified(keyframe(walk, 0, 0), keyframe(walk, 6, 6, blur=1.5))
    assert not pair.reason and error_deg(walk, pair, 0, 6) < 0.3


@pytest.mark.parametrize("match", [10, 20])
def test_bent_images_of_opposite_turns_are_rejected(walk, match, monkeypatch):
    """A rolling shutter of 27 ms, rolling by 150 degrees per second."""

    def bent(index: int, turn_rad_s: float) -> Keyframe:
        frame = replace(walk[0][index], readout_s=0.027)
        velocity = np.array([0, 0, 0, 0, 0, turn_rad_s])
        rgb, depth_m = as_exposed(frame.rgb, frame.depth_m, frame, velocity)
        return Keyframe.from_frame(replace(frame, rgb=rgb, depth_m=depth_m), np.eye(4))

    first, second = bent(match, 2.6), bent(match + 6, -2.6)
    confirmed = verified_without_comparison(first, second)
    assert not confirmed.reason
    monkeypatch.setattr(pair_matching, "_MIN_CORRELATION", 0.0)
    assert "displaced" in verified(first, second).reason
    alike = verified(first, bent(match + 6, 2.6))
    assert not alike.reason and error_deg(walk, alike, match, match + 6) < 0.5


def test_what_is_rejected_before_needs_no_evidence(walk, monkeypatch):
    monkeypatch.setattr(pair_matching, "_MAX_DISAGREEMENT_M", 1e-9)
    pair = verified(keyframe(walk, 0, 0), keyframe(walk, 4, 4))
    assert pair.reason and pair.evidence is None and "correlation" not in pair_values(pair)
