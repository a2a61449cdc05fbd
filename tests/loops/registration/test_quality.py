"""What an alignment is worth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from registered_room import Scene, motion

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.loops.registration import views
from toolkit.slam.loops.registration.quality import check_alignment, compare
from toolkit.slam.loops.registration.views import SubmapView, views_of_overlap
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.gaussians.cloud import GaussianCloud

CAMERA = Camera(20.0, 20.0, 9.5, 7.5, 20, 16)


def wall(depth_m: float, class_id: int = 1) -> SubmapView:
    flat = torch.full((16, 20), depth_m)
    return SubmapView(FrameLevel(CAMERA, torch.zeros(16, 20), flat), np.full((16, 20), class_id))


def test_a_wall_fits_itself():
    check = compare(wall(2.0), wall(2.0))
    assert check.pixels == 320
    assert check.overlap == check.inliers == check.class_agreement == 1.0


def test_a_wall_in_front_is_a_contradiction():
    check = compare(wall(1.5), wall(2.0))
    assert check.overlap == 1.0
    assert check.inliers == 0.0
    assert np.isnan(check.class_agreement)


def test_depth_and_class_are_judged_apart():
    check = compare(wall(2.0, class_id=1), wall(2.04, class_id=2))
    assert check.inliers == 1.0
    assert check.class_agreement == 0.0


def test_half_a_view_aside_is_half_an_overlap():
    half = 2.0 * 10.0 / 20.0  # ten of twenty pixels at two metres
    aside = se3.exp(np.array([half, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert compare(wall(2.0), wall(2.0), aside).overlap == pytest.approx(0.5)


def test_counts_add_up():
    one, two = compare(wall(2.0), wall(2.0)), compare(wall(1.5), wall(2.0))
    both = one + two
    assert both.views == 2
    assert both.inliers == 0.5


def test_the_truth_fits_and_other_places_do_not(room: Scene, renderer):
    right = check_alignment(room.target, room.source, room.T_target_source, renderer)
    assert right.agreeing > 0.85 * right.pixels
    off = room.T_target_source @ motion(1, 0.4, 15.0)
    wrong = check_alignment(room.target, room.source, off, renderer)
    assert wrong.agreeing / wrong.pixels < 0.6 * right.agreeing / right.pixels


def test_large_images_are_drawn_smaller(room: Scene, renderer, monkeypatch):
    monkeypatch.setattr(views, "_MAX_WIDTH", 100)
    assert renderer.camera_of(room.source.keyframes[0]).size == (80, 60)


def test_views_are_those_that_overlap(room: Scene):
    views = views_of_overlap(room.target, room.source, room.T_target_source, 2)
    assert len(views) == 2
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    assert views_of_overlap(room.target, room.source, turned, 5) == []


def looking_at_a_wall() -> Submap:
    """One view of a wall two metres ahead."""
    camera = Camera(80.0, 80.0, 39.5, 29.5, 80, 60)
    rgb, depth_m = np.zeros((60, 80, 3), np.float32), np.full((60, 80), 2.0, np.float32)
    keyframe = Keyframe.from_frame(Frame(0, 0.0, rgb, depth_m, camera), np.eye(4))
    return Submap(0, np.eye(4), GaussianCloud.empty(), [keyframe])


def test_a_wall_seen_from_behind_is_another_one():
    here, there = looking_at_a_wall(), looking_at_a_wall()
    aside = se3.exp(np.array([0.3, 0.0, 0.1, 0.0, 0.1, 0.0]))
    assert views_of_overlap(here, there, aside, 5) == [0]
    # Turned about, and standing in the next room: its wall is eight centimetres behind ours.
    behind = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    behind[2, 3] = 4.08
    assert here.keyframes[0].fraction_seen_by(behind) > 0.9
    assert here.keyframes[0].reaches(np.array([[0.0, 0.0, 2.08]])).all()
    assert views_of_overlap(here, there, behind, 5) == []
