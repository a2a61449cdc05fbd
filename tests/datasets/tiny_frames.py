"""Frames and poses of the tiny recordings in `conftest.py`."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from toolkit.base.geometry import se3

WIDTH, HEIGHT = 32, 24


def frame_rgb(index: int) -> np.ndarray:
    """Random colour image, different for every frame."""
    return np.random.default_rng(index).uniform(size=(HEIGHT, WIDTH, 3))


def frame_depth_m(index: int) -> np.ndarray:
    """Depth of a tilted plane whose distance grows with the frame number."""
    return np.tile(np.linspace(1.0, 2.0, WIDTH), (HEIGHT, 1)) + 0.1 * index


def pose(index: int) -> np.ndarray:
    """Poses with rotation and translation."""
    return se3.exp(np.array([0.1 * index, 0.0, 0.05 * index, 0.0, 0.02 * index, 0.0]))


def camera_file(index: int, **changes: Any) -> str:
    """Camera of a frame; ARKit's y axis is up and its z axis back."""
    T = pose(index) @ np.diag([1.0, -1.0, -1.0, 1.0])
    content = {f"t_{i}{j}": T[i, j] for i in range(3) for j in range(4)}
    content |= {"fx": 60.0, "fy": 62.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
    return json.dumps(content | {"blur_score": 0.1} | changes)
