"""Odometry that starts again after the camera was lost, and the connection of its parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving_camera import Film, error_m, film, walk

from toolkit.base.frame import Frame
from toolkit.depth.monocular.motion import CameraMotion, estimate_motion
from toolkit.depth.monocular.sequence import MonocularSequence
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings

PATH = walk(28)


def covered(count: int, like: Frame) -> list[Frame]:
    return [replace(like, rgb=np.full_like(like.rgb, 0.3)) for _ in range(count)]


def numbered(frames: list[Frame]) -> list[Frame]:
    return [replace(frame, index=n, timestamp_s=n / 30) for n, frame in enumerate(frames)]


def motion_of(frames: list[Frame]) -> CameraMotion:
    return estimate_motion(numbered(frames), frames[0].camera)


@pytest.fixture(scope="module")
def walked() -> list[Frame]:
    return film(PATH)


THERE, BACK = list(range(18)), list(range(27, 11, -1))


def interrupted(walked: list[Frame]) -> list[Frame]:
    """A walk there and back, with the lens covered in between."""
    return [*(walked[n] for n in THERE), *covered(12, walked[0]), *(walked[n] for n in BACK)]


@pytest.fixture(scope="module")
def connected(walked) -> CameraMotion:
    return motion_of(interrupted(walked))


def test_parts_before_and_after_a_covered_lens_are_connected(connected):
    assert len(connected.trajectory) > 30  # of 34
    shown = [*THERE, *[0] * 12, *BACK]
    numbers = np.round(connected.trajectory.timestamps_s * 30).astype(int)
    # An uninterrupted walk there and back has 0.02.
    assert error_m(connected.trajectory, PATH[[shown[n] for n in numbers]])[0] < 0.04
    # The covered frames are too many; nothing else is wrong.
    assert len(connected.doubts) == 1
    assert "have no pose" in connected.doubts[0]


def elsewhere(walked: list[Frame]) -> list[Frame]:
    """A walk, a covered lens, and a walk at another place, with less frames."""
    other = [replace(frame, rgb=np.roll(1.0 - frame.rgb[::-1], 60, 1)) for frame in walked[:14]]
    return numbered([*walked[:18], *covered(12, walked[0]), *other])


def numbers(motion: CameraMotion) -> set[int]:
    return set(np.round(motion.trajectory.timestamps_s * 30).astype(int))


def test_a_part_that_shows_another_place_is_apart(walked):
    motion = motion_of(elsewhere(walked))
    assert numbers(motion) <= set(range(18))
    assert len(motion.trajectory) >= 16
    (other,) = motion.others
    assert numbers(other) <= set(range(30, 44))
    assert len(other.trajectory) >= 10
    assert motion.frames_in_others == len(other.trajectory)
    assert not motion.reliable
    assert "position and scale are unknown" in motion.doubts[0]


def test_each_part_gets_a_map_of_its_own(walked, tmp_path):
    frames = elsewhere(walked)
    sequence = MonocularSequence(Film(frames), motion_of(frames))
    slam = build_slam(sequence, RunSettings(depth="none"))
    for frame in sequence:
        slam.process_frame(frame)
    result = slam.finish()
    _, other = result.parts
    assert set(result.frame_indices) <= set(range(18))
    (part,) = result.other_parts
    assert part.submaps == other
    assert len(part.frames.indices) >= 8
    assert min(part.frames.indices) >= 30
    assert part.map is not None
    # Its frame is that of its first keyframe, and no Gaussian of the main part is in it.
    np.testing.assert_allclose(result.submaps[other[0]].T_world_submap, np.eye(4), atol=1e-9)
    assert set(result.submaps[other[0]].keyframe_indices) <= set(range(30, 44))


def test_a_short_loss_does_not_start_again(walked):
    frames = [*walked[:14], *covered(4, walked[0]), *walked[14:20]]
    motion = motion_of(frames)
    known = set(np.round(motion.trajectory.timestamps_s * 30).astype(int))
    assert known == set(range(24)) - {14, 15, 16, 17}


def test_the_result_is_reproducible(walked, connected):
    again = motion_of(interrupted(walked)).trajectory
    assert again.T_world_camera.tobytes() == connected.trajectory.T_world_camera.tobytes()
