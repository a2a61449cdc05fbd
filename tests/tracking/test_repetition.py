"""Other poses at which a repeating pattern looks the same."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.tracking.reach import Reach
from toolkit.slam.tracking.repetition import repeats_beyond, repetitions
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import model_level

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
DEPTH_M, PERIOD_PX = 2.0, 12
PERIOD_M = PERIOD_PX * DEPTH_M / CAMERA.fx


def places(intensity: NDArray[np.float64], metres: float) -> list[float]:
    """Where a frame before a wall looks the same, to the right, if the camera may be this far."""
    noise = np.random.default_rng(0).normal(scale=0.005, size=intensity.shape)
    frame, shown = (
        FrameLevel(
            CAMERA,
            torch.from_numpy(image.astype(np.float32)),
            torch.full((CAMERA.height, CAMERA.width), DEPTH_M),
        )
        for image in (intensity + noise, intensity)
    )
    task = SimpleNamespace(levels=[frame], prepared=SimpleNamespace(median_depth_m=DEPTH_M))
    view = SimpleNamespace(levels=[model_level(shown)], T_map_view=np.eye(4))
    T = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    found = repetitions(task, view, np.eye(4), Reach(T, metres, 0.1))  # type: ignore[arg-type]
    assert all(abs(pose[1, 3]) < 0.1 * PERIOD_M for pose in found)
    return sorted(float(pose[0, 3]) for pose in found)


def border() -> NDArray[np.float64]:
    """A pattern that repeats to the side, and differs from row to row."""
    x = np.arange(CAMERA.width) - CAMERA.cx
    rows = 0.5 * np.random.default_rng(2).random((CAMERA.height, 1))
    return 0.3 + 0.2 * np.sin(2.0 * np.pi * x / PERIOD_PX) + rows


def test_a_pattern_looks_the_same_a_period_away():
    assert places(border(), 1.2 * PERIOD_M) == pytest.approx([-PERIOD_M, PERIOD_M], abs=0.03)


def test_periods_out_of_reach_are_left_out():
    assert not places(border(), 0.5 * PERIOD_M)


def test_texture_that_does_not_repeat_and_a_blank_wall_look_the_same_nowhere():
    texture = np.random.default_rng(1).random((CAMERA.height, CAMERA.width))
    assert not places(texture, 2.0 * PERIOD_M)
    assert not places(np.full((CAMERA.height, CAMERA.width), 0.5), 2.0 * PERIOD_M)


def test_a_pattern_may_go_on_where_the_map_ends():
    texture = np.random.default_rng(1).random((CAMERA.height, CAMERA.width))
    assert goes_on(border(), seen=0.4)
    assert not goes_on(border(), seen=1.0)
    assert not goes_on(texture, seen=0.4)


def goes_on(intensity: NDArray[np.float64], seen: float) -> bool:
    """Whether a frame may be elsewhere before a map of this share of the wall, from the left."""
    images = torch.from_numpy(intensity.astype(np.float32))
    depth = torch.full((CAMERA.height, CAMERA.width), DEPTH_M)
    frame, mapped = FrameLevel(CAMERA, images, depth), depth.clone()
    mapped[:, int(seen * CAMERA.width) :] = 0.0
    task = SimpleNamespace(levels=[frame], prepared=SimpleNamespace(median_depth_m=DEPTH_M))
    levels = [model_level(FrameLevel(CAMERA, images, mapped))]
    view = SimpleNamespace(levels=levels, T_map_view=np.eye(4))
    reach = Reach(np.eye(4), 1.2 * PERIOD_M, 0.1)
    return repeats_beyond(task, view, np.eye(4), reach)  # type: ignore[arg-type]
