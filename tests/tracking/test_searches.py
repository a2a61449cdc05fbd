"""Initial poses of unclear frames: from features, and from many rotations."""

from __future__ import annotations

import numpy as np
from tracked_room import Room, assert_same_place, blind_frame, distance_mm, small_motion

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.proposals import FeatureProposals
from toolkit.slam.tracking.rotation_search import wide_camera
from toolkit.splatting.gaussians.cloud import GaussianCloud


def nothing(_view: Keyframe) -> list[Keyframe]:
    return []


def test_features_give_the_pose_relative_to_a_keyframe(room: Room):
    keyframe = Keyframe.from_frame(room.frames[0], room.T_map_camera[0])
    found = list(FeatureProposals().poses(room.frames[4], [keyframe], nothing))
    assert len(found) == 1
    assert_same_place(found[0], room.T_map_camera[4], mm=40.0, deg=1.5)


def test_similar_keyframes_are_matched_after_the_newest_ones(room: Room):
    first, *others = (
        Keyframe.from_frame(f, T) for f, T in zip(room.frames, room.T_map_camera, strict=True)
    )
    poses = FeatureProposals().poses(room.frames[1], others[-1:], lambda _view: [first])
    assert 1 <= len(list(poses)) <= 2


def test_a_frame_without_depth_has_no_proposals(room: Room):
    keyframe = Keyframe.from_frame(room.frames[0], room.T_map_camera[0])
    assert not list(FeatureProposals().poses(blind_frame(room.frames[1]), [keyframe], nothing))


def test_the_wide_camera_sees_the_same_rays_and_more():
    camera = Camera(160.0, 150.0, 79.5, 59.5, 160, 120)
    wide = wide_camera(camera)
    assert wide.width % 8 == wide.height % 4 == 0
    assert wide.fx == camera.fx / 2 and wide.width > camera.width / 2 + 40
    ray = np.array([0.1, -0.2, 1.0])
    # The centre of the narrow half image lies at its margin's distance from the border.
    half = camera.halved()
    offset = wide.project(ray) - half.project(ray)
    assert np.allclose(offset, np.round(offset)) and (offset > 0).all()


def test_turns_beyond_the_reach_of_alignment_are_found(room: Room, gaussians: GaussianCloud):
    """Without features: the tracker tries rotations by itself."""
    true = room.T_map_camera[1]
    start = true @ se3.exp(np.radians([0.0, 0.0, 0.0, 0.0, 35.0, 0.0]))
    found = {}
    for search in (False, True):
        tracker = DenseTracker()
        tracker.first_pose(room.frames[0])
        found[search] = tracker.locate(room.frames[1], gaussians, start, search=search).T_map_camera
    assert distance_mm(found[False], true) > 50.0
    assert_same_place(found[True], true, mm=3.0, deg=0.15)


def test_a_clear_frame_needs_no_search(room: Room, gaussians: GaussianCloud):
    asked: list[int] = []

    def proposals(frame):
        asked.append(frame.index)
        return iter(())

    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    for frame in room.frames[1:4]:
        tracker.track(frame, gaussians, proposals)
    assert not asked
    far = room.T_map_camera[3] @ small_motion(5, metres=0.5, degrees=60.0)
    tracker.continue_from(room.frames[3].timestamp_s, far)
    tracker.track(room.frames[4], gaussians, proposals)
    assert asked == [room.frames[4].index]
