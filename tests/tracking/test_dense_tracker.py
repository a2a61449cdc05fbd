"""The dense tracker on a small room: what it finds, and what it owns to have lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracked_room import (
    Room,
    assert_same_place,
    blank_frame,
    blind_frame,
    dead_sensor_frame,
    distance_mm,
    frame_from_elsewhere,
    ideal_frame,
    small_motion,
)

from toolkit.base.geometry import se3
from toolkit.slam.tracking import dense
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.result import Health
from toolkit.splatting.alignment import backend as alignment_backend
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import surface, texture


def started(room: Room) -> DenseTracker:
    """A tracker that has seen the first frame."""
    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    return tracker


def test_the_first_camera_is_the_map(room):
    tracker = DenseTracker()
    assert np.array_equal(tracker.first_pose(room.frames[0]), np.eye(4))
    assert np.array_equal(tracker.motion.last(), np.eye(4))


def test_known_motion_is_recovered(room, gaussians):
    result = started(room).track(room.frames[1], gaussians)
    assert_same_place(result.T_map_camera, room.T_map_camera[1], mm=1.0, deg=0.05)
    assert result.health is Health.GOOD and result.reason == ""
    assert result.converged
    assert 1 <= result.renders <= dense._RENDERS
    assert result.iterations >= result.renders
    assert 0.4 < result.visible_fraction <= 1.0


def test_a_view_of_the_map_itself_is_found_almost_exactly(room, gaussians):
    pose = small_motion(0, metres=0.03, degrees=2.0)
    gaussians = replace(gaussians, centred_colours=False)
    frame = ideal_frame(gaussians, room.frames[1], pose)
    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    result = tracker.track(frame, gaussians)
    assert_same_place(result.T_map_camera, pose, mm=0.5, deg=0.02)


@pytest.mark.parametrize("seed", range(6))
def test_starts_within_the_basin_end_at_one_place(room, gaussians, seed):
    """Four centimetres and three degrees: ten pixels at this size."""
    pose = room.T_map_camera[1]
    start = pose @ small_motion(seed, metres=0.04, degrees=3.0)
    result = started(room).locate(room.frames[1], gaussians, start)
    assert not result.lost
    assert_same_place(result.T_map_camera, pose, mm=1.5, deg=0.08)


def test_a_pose_is_rigid_even_where_alignment_gives_up_at_once(room, gaussians):
    """Rounding errors of the start came back threefold, and grew from frame to frame."""
    start = room.T_map_camera[1].copy()
    start[:3, :3] *= 1.0 + 1e-7
    result = started(room).locate(blind_frame(room.frames[1]), gaussians, start)
    assert se3.is_rigid(result.T_map_camera, 1e-12)
    assert_same_place(result.T_map_camera, room.T_map_camera[1], mm=0.01, deg=0.001)


def test_exposure_is_recovered_and_leaves_the_pose_alone(room, gaussians):
    tracker = started(room)
    for frame, pose in zip(room.frames[1:], room.T_map_camera[1:], strict=True):
        darker = replace(frame, rgb=frame.rgb * np.float32(0.8) + np.float32(0.05))
        result = tracker.track(darker, gaussians)
        assert_same_place(result.T_map_camera, pose, mm=3.0, deg=0.1)
    # A prior lets it follow a sudden change over some frames only.
    middle = darker.rgb.mean(keepdims=True)
    exposure = result.exposure
    assert exposure.gain == pytest.approx(1.25, abs=0.12)
    assert exposure.apply(middle) == pytest.approx(float(frame.rgb.mean()), abs=0.02)


@pytest.mark.parametrize(
    "make", [blank_frame, blind_frame, dead_sensor_frame, frame_from_elsewhere]
)
def test_frames_that_cannot_be_placed_are_lost(room, gaussians, make):
    tracker = started(room)
    tracker.track(room.frames[1], gaussians)
    place = tracker.motion.last()
    result = tracker.track(make(room.frames[2]), gaussians)
    assert result.lost
    assert result.reason
    assert np.isfinite(result.T_map_camera).all()
    # The camera is where it was last seen, at zero velocity.
    assert np.array_equal(tracker.motion.predict(room.frames[3].timestamp_s), place)


def test_it_recovers_after_a_lost_frame(room, gaussians):
    tracker = started(room)
    tracker.track(room.frames[1], gaussians)
    assert tracker.track(blind_frame(room.frames[2]), gaussians).lost
    result = tracker.track(room.frames[3], gaussians)
    assert_same_place(result.T_map_camera, room.T_map_camera[3], mm=1.5, deg=0.08)


def test_a_doubt_ends_only_with_clear_evidence(room, gaussians, monkeypatch):
    tracker = started(room)
    blurred = replace(room.frames[1], rgb=0.5 * room.frames[1].rgb[::-1] + 0.25)
    assert tracker.track(blurred, gaussians).doubtful
    with monkeypatch.context() as unclear:
        unclear.setattr(dense, "_SURE_COVERED", 0.99)
        found = tracker.track(room.frames[2], gaussians)
    assert found.doubtful and "doubtful frames" in found.reason
    assert_same_place(found.T_map_camera, room.T_map_camera[2], mm=5.0, deg=0.3)
    assert tracker.track(room.frames[3], gaussians).health is Health.GOOD


def test_the_first_motion_of_a_new_part_is_one_that_the_camera_can_have_made(room, gaussians):
    tracker = started(room)
    tracker.track(room.frames[1], gaussians)
    frame = room.frames[2]
    far = room.T_map_camera[2] @ se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    tracker.continue_from(room.frames[1].timestamp_s, far)
    result = tracker.track(frame, gaussians)
    assert result.lost and result.reason == "the camera cannot have moved so far"
    tracker.continue_from(room.frames[1].timestamp_s, room.T_map_camera[1])
    assert tracker.track(frame, gaussians).health is Health.GOOD


def test_a_place_that_the_camera_cannot_have_reached_is_another_one(room, gaussians, monkeypatch):
    tracker = started(room)
    found = tracker.track(room.frames[1], gaussians)
    far = se3.exp(np.array([1.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    monkeypatch.setattr(
        tracker, "locate", lambda *_, **__: replace(found, T_map_camera=found.T_map_camera @ far)
    )
    result = tracker.track(room.frames[2], gaussians)
    assert result.lost and result.ambiguous and "cannot have moved" in result.reason
    assert np.array_equal(tracker.motion.last(), found.T_map_camera)
    later = replace(room.frames[2], timestamp_s=room.frames[1].timestamp_s + 1.0)
    assert not tracker.track(later, gaussians).lost


def test_an_empty_map_loses_every_frame(room):
    result = started(room).track(room.frames[1], GaussianCloud.empty())
    assert result.lost and result.visible_fraction == 0.0


def test_locating_leaves_the_tracker_as_it_was(room, gaussians):
    tracker = started(room)
    before = tracker.state()
    tracker.locate(room.frames[1], gaussians, np.eye(4))
    after = tracker.state()
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[k], after[k]) for k in before)


def test_a_restored_tracker_goes_on_with_the_same_bits(room, gaussians):
    tracker = started(room)
    for frame in room.frames[1:3]:
        tracker.track(frame, gaussians)
    other = DenseTracker()
    other.restore({name: array.copy() for name, array in tracker.state().items()})
    for frame in room.frames[3:5]:
        here, there = tracker.track(frame, gaussians), other.track(frame, gaussians)
        assert here.T_map_camera.tobytes() == there.T_map_camera.tobytes()
        assert here.information.tobytes() == there.information.tobytes()
        assert here.exposure == there.exposure


def test_information_is_a_covariance_inverse(room, gaussians):
    """Symmetric, positive, and larger the more pixels speak."""
    result = started(room).track(room.frames[1], gaussians)
    assert np.allclose(result.information, result.information.T)
    assert np.linalg.eigvalsh(result.information)[0] > 0
    fewer = room.frames[1].depth_m.copy()
    fewer[:, ::2] = 0.0
    halved = started(room).track(replace(room.frames[1], depth_m=fewer), gaussians)
    assert np.trace(halved.information) < 0.8 * np.trace(result.information)


def test_errors_are_as_large_as_the_information_says(room, gaussians):
    """Noise on depth and colour moves the pose by about its standard deviation.

    Squared errors in units of the estimated covariance have mean 6 (six degrees of freedom) if
    pixels are independent. Bilinear samples of neighbouring pixels are not: the mean here is 13.1.
    The bounds are a factor of two either way, so an information matrix off by that factor fails.
    """
    pose = room.T_map_camera[1]
    gaussians = replace(gaussians, centred_colours=False)
    clean = ideal_frame(gaussians, room.frames[1], pose)
    generator = np.random.default_rng(0)
    squares = []
    for _ in range(8):
        rgb = clean.rgb + generator.normal(scale=0.03, size=clean.rgb.shape)
        depth = clean.depth_m * (1 + generator.normal(scale=0.003, size=clean.depth_m.shape))
        noisy = replace(
            clean,
            rgb=rgb.clip(0, 1).astype(np.float32),
            depth_m=np.where(clean.depth_m > 0, depth, 0).astype(np.float32),
        )
        result = DenseTracker().locate(noisy, gaussians, pose)
        error = se3.log(se3.inverse(pose) @ result.T_map_camera)
        squares.append(error @ result.information @ error)
    assert 6.6 < np.mean(squares) < 26.0


def test_it_works_without_compiled_kernels(room, gaussians, monkeypatch):
    for module in (surface, texture, alignment_backend):
        monkeypatch.setattr(module, "kernels_for", lambda tensor: None)
    tracker = DenseTracker(backend_name="reference")
    tracker.first_pose(room.frames[0])
    result = tracker.track(room.frames[1], gaussians)
    assert_same_place(result.T_map_camera, room.T_map_camera[1])
    assert distance_mm(result.T_map_camera, np.eye(4)) > 10.0
