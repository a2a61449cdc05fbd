"""Views that do not determine the motion of the camera: frames are doubtful, never guessed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from slam_room import FEW

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker

CAMERA = Camera(128.0, 128.0, 79.5, 59.5, 160, 120)
Grey = NDArray[np.float64]


def frame(index: int, grey: Grey, depth_m: Grey) -> Frame:
    """A frame with half a per cent of noise."""
    rng = np.random.default_rng(index)
    rgb = grey[..., None] + 0.005 * rng.standard_normal((*grey.shape, 3))
    noisy = depth_m * (1.0 + 0.002 * rng.standard_normal(grey.shape))
    return Frame(index, index / 30, rgb.astype(np.float32), noisy.astype(np.float32), CAMERA)


def stripes(x: Grey, _y: Grey) -> Grey:
    return 0.5 + 0.3 * np.sin(2 * np.pi * x / 0.15)


def blank(x: Grey, _y: Grey) -> Grey:
    return np.full_like(x, 0.6)


def marks(x: Grey, y: Grey) -> Grey:
    """No pattern repeats."""
    waves = np.random.default_rng(3).uniform(-40.0, 40.0, (24, 3))
    return 0.5 + 0.04 * sum(np.sin(a * x + b * y + c) for a, b, c in waves)


def wall(index: int, pattern: Callable[[Grey, Grey], Grey], step_m: float) -> Frame:
    """A wall at 1.5 m, along which the camera moves upwards."""
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    x = 1.5 * (column - CAMERA.cx) / CAMERA.fx
    y = 1.5 * (row - CAMERA.cy) / CAMERA.fy - step_m * index
    return frame(index, pattern(x, y), np.full_like(x, 1.5))


def passing_object(index: int) -> Frame:
    """The camera stands still, and an object that fills half of the view slides by."""
    row, column = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    x, y = (column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy
    before = column < 80 + 2 * index
    near = marks(1.5 * x - 0.025 * index + 9.0, 1.5 * y)
    return frame(index, np.where(before, near, marks(4 * x, 4 * y)), np.where(before, 1.5, 4.0))


def doubts(frames: list[Frame]) -> list[str]:
    """Why frames after the first are doubtful; empty for tracked ones."""
    slam = Slam(FrontEnd(DenseTracker()), Mapper(FEW, np.random.default_rng(0)))
    results = [slam.process_frame(one) for one in frames]
    assert not any(result.lost for result in results)
    return [r.tracking.reason if r.doubtful else "" for r in results[1:] if r.tracking]


@pytest.mark.parametrize("pattern", [stripes, blank])
def test_motion_along_stripes_or_a_blank_wall_is_not_guessed(pattern):
    reasons = doubts([wall(index, pattern, 0.01) for index in range(4)])
    assert all("does not determine the motion" in reason for reason in reasons)


def test_motion_along_a_wall_with_marks_is_tracked():
    assert not any(doubts([wall(index, marks, 0.01) for index in range(4)]))


def test_an_object_that_fills_half_of_the_view_makes_frames_doubtful():
    reasons = doubts([passing_object(index) for index in range(4)])
    assert all("features move in one way" in reason for reason in reasons)
