"""The motion of a camera from its images."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from moving_camera import error_m, film, turn, walk

from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.depth.monocular.visual_odometry.odometry import OdometryResult, State, VisualOdometry
from toolkit.semantics.features.tracks import FeatureTracks
from toolkit.splatting.alignment.levels import intensity_of


def grey(frame: Frame) -> np.ndarray:
    return np.round(255 * intensity_of(frame.rgb).numpy()).astype(np.uint8)


def fed(frames: Sequence[Frame]) -> tuple[VisualOdometry, list[OdometryResult]]:
    odometry = VisualOdometry(frames[0].camera)
    return odometry, [odometry.process(grey(frame)) for frame in frames]


def trajectory(odometry: VisualOdometry, frames: int) -> Trajectory:
    poses = [odometry.map.T_world_camera(n) for n in range(frames)]
    assert all(pose is not None for pose in poses)
    return Trajectory(np.arange(frames) / 30.0, np.array(poses))


@pytest.fixture(scope="module")
def walked() -> list[Frame]:
    return film(walk())


def test_a_walk_is_found_up_to_scale(walked):
    odometry, results = fed(walked)
    assert results[-1].state is State.TRACKING
    error, scale = error_m(trajectory(odometry, len(walked)), walk())
    assert error < 0.02  # of 60 cm
    assert scale == pytest.approx(2.5 / 2.0, rel=0.4)  # the median depth becomes 2


def test_frames_before_the_initialisation_get_poses_later(walked):
    odometry, results = fed(walked)
    first = next(n for n, result in enumerate(results) if result.state is State.TRACKING)
    assert first > 1
    assert all(odometry.map.T_world_camera(n) is not None for n in range(first))


def test_results_are_reproducible(walked):
    first, second = (trajectory(fed(walked)[0], len(walked)) for _ in range(2))
    assert first.T_world_camera.tobytes() == second.T_world_camera.tobytes()


def test_a_rotation_creates_no_structure():
    odometry, results = fed(film(turn()))
    assert {result.state for result in results} == {State.INITIALISING}
    assert results[-1].reason == "the camera has only turned"
    assert not odometry.map.views


def test_a_rotation_after_a_walk_is_tracked():
    there = walk()
    frames = film(np.concatenate([there, there[-1] @ turn(10)]))
    odometry, results = fed(frames)
    assert results[-1].state is State.TRACKING
    last, before = (odometry.map.T_world_camera(n) for n in (len(frames) - 1, len(there) - 1))
    angle = np.degrees(np.arccos((np.trace(before[:3, :3].T @ last[:3, :3]) - 1) / 2))
    assert angle == pytest.approx(np.degrees(0.03 * 9), abs=0.5)


def test_images_without_texture_are_lost():
    frames = film(walk())
    odometry = VisualOdometry(frames[0].camera)
    for frame in frames:
        odometry.process(grey(frame))
    blank = odometry.process(np.full((120, 160), 128, np.uint8))
    assert blank.state is State.LOST
    assert blank.T_world_camera is None
    assert "followed" in blank.reason


def test_tracking_continues_after_covered_images(walked):
    odometry = VisualOdometry(walked[0].camera)
    covered = [*walked[:8], *[None] * 3, *walked[8:]]
    states = []
    for frame in covered:
        image = np.full((120, 160), 30, np.uint8) if frame is None else grey(frame)
        states.append(odometry.process(image).state)
    assert states[8:11] == [State.LOST] * 3
    assert states[11:] == [State.TRACKING] * len(walked[8:])
    known = [n for n in range(len(covered)) if n not in (8, 9, 10)]
    poses = np.array([odometry.map.T_world_camera(n) for n in known])
    error, _ = error_m(Trajectory(np.arange(len(known)) / 30.0, poses), walk())
    assert error < 0.02


def test_tracks_follow_the_image(walked):
    tracks = FeatureTracks(100)
    tracks.follow(grey(walked[0]))
    first = tracks.replenish()
    assert len(first) > 30
    shifted = np.roll(grey(walked[0]), (2, 5), (0, 1))
    found = tracks.follow(shifted)
    _, at, now = np.intersect1d(first.ids, found.ids, return_indices=True)
    moved = found.px[now] - first.px[at]
    np.testing.assert_allclose(np.median(moved, axis=0), [5.0, 2.0], atol=0.05)


def test_tracks_survive_a_motion_too_large_for_optical_flow():
    rng = np.random.default_rng(2)
    scene = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (260, 460)).astype(np.float32), None, 3.0)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    tracks = FeatureTracks(200)
    tracks.follow(np.ascontiguousarray(scene[:240, :320]))
    first = tracks.replenish()
    found = tracks.follow(np.ascontiguousarray(scene[20:, 130:450]))
    _, at, now = np.intersect1d(first.ids, found.ids, return_indices=True)
    visible = (first.px > [135.0, 25.0]).all(1)
    assert len(at) > 0.7 * visible.sum()
    moved = found.px[now] - first.px[at]
    np.testing.assert_allclose(np.median(moved, axis=0), [-130.0, -20.0], atol=0.05)


def test_new_features_keep_their_distance(walked):
    tracks = FeatureTracks(60)
    tracks.follow(grey(walked[0]))
    tracks.replenish()
    tracks.keep(np.arange(len(tracks.features)) % 2 == 0)
    features = tracks.replenish()
    distance = np.linalg.norm(features.px[:, None] - features.px[None], axis=2)
    assert distance[distance > 0].min() > 5.0
    assert len(np.unique(features.ids)) == len(features)


@pytest.mark.parametrize(("gain", "bias"), [(1.6, 0.0), (0.5, 20.0)])
def test_tracks_survive_a_change_of_exposure(walked, gain, bias):
    tracks = FeatureTracks(150)
    tracks.follow((0.5 * grey(walked[0])).astype(np.uint8))
    first = tracks.replenish()
    changed = np.clip(gain * 0.5 * grey(walked[1]) + bias, 0, 255).astype(np.uint8)
    found = tracks.follow(changed)
    assert len(found) > 0.6 * len(first)
    same = FeatureTracks(150)
    same.follow(grey(walked[0]))
    same.continue_from(grey(walked[0]), first)
    reference = same.follow(grey(walked[1]))
    _, a, b = np.intersect1d(found.ids, reference.ids, return_indices=True)
    assert np.median(np.linalg.norm(found.px[a] - reference.px[b], axis=1)) < 0.1
