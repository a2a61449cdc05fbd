"""Where a lost camera may be: near its last pose, unless the recording was cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam_room import blind_frames, fed, first_steps, new_slam

from toolkit.base.frame import Frame
from toolkit.slam.camera_path import CameraPath
from toolkit.slam.tracking.result import Health


@pytest.fixture(scope="module")
def tracked():
    """A run of six frames."""
    room = first_steps(8)
    slam = new_slam()
    fed(slam, room.frames[:6])
    return slam, room.frames


def restored(path: CameraPath) -> CameraPath:
    again = CameraPath()
    again.restore(*path.state())
    return again


def after(frame: Frame, seconds: float) -> Frame:
    return replace(frame, index=frame.index + 1, timestamp_s=frame.timestamp_s + seconds)


def test_it_is_near_its_last_pose_for_some_time(tracked):
    slam, frames = tracked
    path, last = restored(slam.camera_path), frames[5]
    T_world_camera = slam.result().trajectory.T_world_camera[-1]
    for seconds in (0.3, 1.0):
        reach = path.reach(slam.atlas, after(last, seconds))
        np.testing.assert_allclose(reach.T_map_camera, T_world_camera, atol=1e-9)
        assert reach.metres == pytest.approx(0.5 + 1.5 * seconds)
        assert reach.radians == pytest.approx(0.5 + 2.0 * seconds)
    assert CameraPath().reach(slam.atlas, last) is None


@pytest.mark.parametrize(("ambiguous", "metres"), [(True, 0.5 + 0.8), (False, 0.5 + 1.5)])
def test_a_doubtful_pose_is_less_wrong_than_none(tracked, ambiguous, metres):
    """But one that the evidence speaks against is none."""
    slam, frames = tracked
    path = restored(slam.camera_path)
    doubt = replace(
        slam.tracker.track(frames[6], slam.atlas.gaussians),
        health=Health.DOUBTFUL,
        reason="a wall",
        ambiguous=ambiguous,
    )
    path.add(after(frames[5], 1.0), slam.atlas, doubt.T_map_camera, doubt)
    path = restored(path)
    reach = path.reach(slam.atlas, after(frames[5], 1.0))
    assert reach.metres == pytest.approx(metres)
    number, T_submap_camera = path.last_pose(slam.atlas)
    newest = slam.atlas.T_world_submap(number) @ T_submap_camera
    assert np.allclose(reach.T_map_camera, newest, atol=1e-9) == ambiguous


@pytest.mark.parametrize(
    ("seconds", "content", "ambiguous", "cut"),
    [
        (0.04, True, False, True),
        (1.0, True, False, False),  # the camera had time to go
        (0.04, False, False, False),  # a covered lens
        (0.04, True, True, False),  # the next door looks like this one
    ],
)
def test_after_a_cut_it_may_be_anywhere(tracked, seconds, content, ambiguous, cut):
    slam, frames = tracked
    path, (blind,) = restored(slam.camera_path), blind_frames(frames[6:7])
    lost = replace(frames[6] if content else blind, timestamp_s=frames[5].timestamp_s + seconds)
    path.add_lost(lost, "nothing matches", ambiguous=ambiguous)
    path = restored(path)
    assert (path.reach(slam.atlas, after(lost, 1.0)) is None) == cut
    path.add(after(lost, 2.0), slam.atlas, np.eye(4), None)
    assert path.reach(slam.atlas, after(lost, 3.0)) is not None
