"""Given poses over many submaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.slam.tracking.given import GivenPoses
from toolkit.slam.tracking.guided import GuidedTracker
from toolkit.splatting.gaussians.cloud import GaussianCloud


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 1000))
def test_poses_stay_rigid_over_a_hundred_submaps(seed: int) -> None:
    frames, truth = tiny_room(4, 20, 16)
    tracker, empty = GivenPoses(truth), GaussianCloud.empty()
    rng = np.random.default_rng(seed)
    T_world_map = np.eye(4)
    for number in rng.integers(0, len(frames), 100):
        pose = tracker.track(frames[number], empty).T_map_camera
        tracker.change_frame(se3.inverse(pose))
        T_world_map = se3.orthonormalise(T_world_map @ pose)
    for frame, T_world_camera in zip(frames, truth.T_world_camera, strict=True):
        T = tracker.track(frame, empty).T_map_camera
        assert se3.is_rigid(T, 1e-12)
        np.testing.assert_allclose(T_world_map @ T, T_world_camera, atol=1e-10)


def test_frames_without_a_pose_state_what_is_missing() -> None:
    frames, truth = tiny_room(4, 20, 16)
    later = replace(frames[3], timestamp_s=99.0)
    given, guided = GivenPoses(truth), GuidedTracker([truth])
    for tracker, words in ((given, "dataset has no pose"), (guided, "not be estimated")):
        result = tracker.track(later, GaussianCloud.empty())
        assert result.lost
        assert words in result.reason
