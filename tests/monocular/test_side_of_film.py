"""The side that is up in a film, by the depth that its keyframes agree on."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from moving_camera import Film, film
from test_camera_motion import motion_of

from toolkit.base.errors import SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.options import ScaleOptions
from toolkit.runs.modes import mode_of
from toolkit.runs.motion import side_of_motion
from toolkit.runs.settings import RunSettings


def turned(frame: Frame) -> Frame:
    """The frame of a camera that is turned by a quarter to the right: its left side is up."""
    own = frame.camera
    cx = own.width - 1 - own.cx
    camera = Camera(own.fy, own.fx, own.cy, cx, own.height, own.width)
    rgb, depth_m = (np.ascontiguousarray(np.rot90(i)) for i in (frame.rgb, frame.depth_m))
    return Frame(frame.index, frame.timestamp_s, rgb, depth_m, camera)


def looking_down_and_around(frames: int) -> np.ndarray:
    poses = []
    for n in range(frames):
        step = se3.exp([0.05 * n, 0.03 * np.sin(n), 0.02 * n, 0.0, 0.0, 0.0])
        poses.append(step @ se3.exp([0.0, 0.0, 0.0, 0.0, 0.5 * np.sin(n / 4), 0.0]))
    return np.array(poses) @ se3.exp([0.0, 0.0, 0.0, -0.5, 0.0, 0.0])


@pytest.fixture(scope="module")
def sideways():
    frames = [turned(frame) for frame in film(looking_down_and_around(16))]
    recording = SimpleNamespace(up_world=None, ground_truth=None)
    dataset = Film(frames)
    dataset.recording = recording
    return dataset, motion_of(frames)


def test_a_film_of_a_camera_on_its_side_shows_it(sideways):
    dataset, motion = sideways
    found = side_of_motion(motion, dataset, RunSettings().dataset)
    assert found.side == "left"
    assert found.notes == ("the left side of the images is up",)


def test_the_option_decides_without_any_depth(sideways):
    dataset, _ = sideways
    stated = dataclasses.replace(RunSettings().dataset, up="bottom")
    assert side_of_motion(None, dataset, stated).side == "bottom"


def test_given_poses_have_a_scale():
    settings = RunSettings(depth="none", poses="given", scale=ScaleOptions(camera_height_m=1.5))
    with pytest.raises(SettingsError, match="remove --scale"):
        mode_of(settings).check(settings)
