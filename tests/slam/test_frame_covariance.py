"""Covariance of a frame's pose by what it shows and by its shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from slam_room import fed, first_steps, new_slam

from toolkit.slam.frame_covariance import by_shutter, by_view
from toolkit.slam.tracking.result import Health, not_tracked

FRAME = first_steps(1).frames[0]
TURN = np.array([0.3, 0.0, 0.0, 0.0, 1.0, 0.0])


def test_that_of_the_tracker_is_used_or_follows_from_the_information_of_a_pixel():
    result = replace(not_tracked(""), health=Health.GOOD, information=1e6 * np.eye(6))
    pixels = FRAME.camera.width * FRAME.camera.height
    np.testing.assert_allclose(by_view(FRAME, result), np.eye(6) / (1e6 / pixels + 1.0))
    measured = replace(result, covariance=0.1 * np.eye(6))
    assert np.array_equal(by_view(FRAME, measured), 0.1 * np.eye(6))
    assert not by_view(FRAME, not_tracked("dark")).any() and not by_view(FRAME, None).any()


def test_an_unknown_shutter_counts_by_the_velocity():
    uncertain = replace(FRAME, readout_sigma_s=0.01)
    sigmas = np.sqrt(np.diag(by_shutter(uncertain, TURN)))
    np.testing.assert_allclose(sigmas[3:], 0.01)
    distance_m = np.median(FRAME.depth_m)
    np.testing.assert_allclose(sigmas[:3], 0.01 * np.hypot(0.3, distance_m), rtol=0.2)
    assert not by_shutter(FRAME, TURN).any() and not by_shutter(uncertain, 0.0 * TURN).any()


def test_a_run_with_an_unknown_shutter_is_less_certain():
    frames = first_steps(6).frames
    runs = [new_slam(), new_slam()]
    fed(runs[0], frames)
    fed(runs[1], [replace(frame, readout_sigma_s=0.02) for frame in frames])
    known, unknown = (run.camera_path.measured_poses(run.atlas)[-1].view_covariance for run in runs)
    assert np.trace(unknown[3:, 3:]) > 4.0 * np.trace(known[3:, 3:])
