"""Motion and depth of a sequence without depth, and what is said about their reliability."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving_camera import Film, error_m, film, turn, walk, wind

from toolkit.base.frame import Frame
from toolkit.depth.monocular.motion import CameraMotion, combined_focal, estimate_motion
from toolkit.depth.monocular.sequence import MonocularSequence


def motion_of(frames: list[Frame], **options) -> CameraMotion:
    return estimate_motion(frames, frames[0].camera, **options)


@pytest.fixture(scope="module")
def walked() -> list[Frame]:
    return film(walk())


def test_a_walk_is_reliable(walked):
    motion = motion_of(walked)
    assert motion.reliable
    assert len(motion.trajectory) == len(walked)
    assert error_m(motion.trajectory, walk())[0] < 0.02
    metrics = motion.metrics()
    assert metrics["reliable"] is True
    assert metrics["doubts"] == ""
    assert metrics["keyframes"] == len(motion.views) > 3
    assert metrics["focal_px"] is None


def test_true_depth_is_not_used(walked):
    flat = [replace(frame, depth_m=np.zeros_like(frame.depth_m)) for frame in walked]
    first, second = motion_of(walked), motion_of(flat)
    assert first.trajectory.T_world_camera.tobytes() == second.trajectory.T_world_camera.tobytes()


def test_a_camera_that_only_turns_is_not_reliable():
    motion = motion_of(film(turn()))
    assert not motion.reliable
    assert motion.doubts == [
        "the motion of the camera could not be determined: the camera has only turned"
    ]
    assert not motion.views
    assert len(motion.trajectory) == 0
    metrics = motion.metrics()
    assert metrics["reliable"] is False
    assert metrics["extent"] is None


def test_a_frozen_film_is_not_reliable(walked):
    assert not motion_of([replace(walked[0], timestamp_s=n / 30) for n in range(6)]).reliable


def test_images_without_texture_are_not_reliable(walked):
    grey = [replace(frame, rgb=np.full_like(frame.rgb, 0.5)) for frame in walked]
    motion = motion_of(grey)
    assert "features" in motion.doubts[0]


def test_a_camera_that_hardly_moves_is_not_reliable():
    """It moves enough to start, and then only turns."""
    start = walk(6)
    poses = np.concatenate([start, start[-1] @ turn(40)])
    motion = motion_of(film(poses))
    assert any("hardly moved" in doubt for doubt in motion.doubts)


def test_frames_without_pose_are_reported(walked):
    blank = [replace(walked[0], rgb=np.full_like(walked[0].rgb, 0.5)) for _ in range(10)]
    frames = [replace(f, timestamp_s=n / 30) for n, f in enumerate([*walked, *blank])]
    motion = motion_of(frames)
    assert motion.doubts == ["10 of 24 frames have no pose (too few features are followed)"]
    assert motion.without_pose


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_an_unknown_focal_length_is_estimated(factor):
    """It is observable only from turns in several directions."""
    frames = film(wind())
    true = frames[0].camera
    wrong = replace(true, fx=factor * true.fx, fy=factor * true.fy)
    motion = estimate_motion(frames, wrong, calibrated=False)
    assert motion.camera.fx == pytest.approx(true.fx, rel=0.03)
    assert motion.focal_sigma == pytest.approx(0.01, rel=0.5)
    assert motion.metrics()["focal_px"] == motion.camera.fx


def test_a_prior_focal_length_is_kept_where_it_is_not_observable(walked):
    """A walk to the side without turns."""
    true = walked[0].camera
    prior = replace(true, fx=1.02 * true.fx, fy=1.02 * true.fy)
    motion = estimate_motion(walked, prior, calibrated=False, focal_sigma=0.03)
    assert motion.camera.fx == pytest.approx(prior.fx, rel=0.03)
    assert motion.focal_sigma <= 0.03
    assert motion.reliable


def test_a_prior_focal_length_is_corrected_where_it_is_observable():
    frames = film(wind())
    true = frames[0].camera
    prior = replace(true, fx=1.06 * true.fx, fy=1.06 * true.fy)
    motion = estimate_motion(frames, prior, calibrated=False, focal_sigma=0.03)
    assert motion.camera.fx == pytest.approx(true.fx, rel=0.03)


def test_focal_lengths_are_combined_by_their_information():
    assert combined_focal(0.03, 1.5, np.inf) == pytest.approx((1.0, 0.03))
    assert combined_focal(0.03, 1.1, 0.03) == pytest.approx((1.1**0.5, 0.03 / 2**0.5))
    assert combined_focal(0.1, 1.2, 0.001)[0] == pytest.approx(1.2, abs=1e-3)


def test_keyframes_have_depth_and_other_frames_none(walked):
    motion = motion_of(walked)
    sequence = MonocularSequence(Film(walked), motion)
    assert len(sequence) == len(walked)
    scale = error_m(motion.trajectory, walk())[1]
    keyframes = {view.frame for view in motion.views}
    for frame, true in zip(sequence, walked, strict=True):
        known = frame.depth_m > 0
        assert known.any() == (frame.index in keyframes)
        assert frame.rgb is true.rgb
        if known.any():
            relative = np.abs(scale * frame.depth_m / true.depth_m - 1.0)[known]
            assert np.median(relative) < 0.05
