"""Frames inside a painted box, met ray by ray: where Open3D makes no rooms, as on a GPU server."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera

# Walls in the first camera's frame: axis and place (m).
WALLS = ((0, -1.6), (0, 1.9), (1, -1.1), (1, 1.2), (2, -2.0), (2, 2.8))
# A board that hangs before the far wall: its distance, and its bounds in x and y.
BOARD_M, BOARD_X, BOARD_Y = 1.7, (-0.3, 0.6), (-0.5, 0.35)


def path(count: int) -> NDArray[np.float64]:
    """T_map_camera [N, 4, 4] of a slow walk; the map's frame is the first camera's."""
    step = np.array([0.012, -0.006, 0.008, 0.003, -0.006, 0.002])
    return np.array([se3.exp(step * index) for index in range(count)])


def box_frames(T_map_camera: NDArray[np.float64], width: int, height: int) -> list[Frame]:
    """What cameras [N, 4, 4] inside the box see."""
    camera = Camera(0.8 * width, 0.8 * width, width / 2 - 0.5, height / 2 - 0.5, width, height)
    return [box_frame(index, T, camera) for index, T in enumerate(T_map_camera)]


def box_frame(index: int, T_map_camera: NDArray[np.float64], camera: Camera) -> Frame:
    """What one camera [4, 4] inside the box sees."""
    rays = camera.rays() @ T_map_camera[:3, :3].T
    origin = T_map_camera[:3, 3]
    with np.errstate(divide="ignore"):
        met = np.stack([(place - origin[axis]) / rays[..., axis] for axis, place in WALLS])
    # A camera's rays have z = 1, so the way along them is the depth.
    depth_m = np.where(met > 0, met, np.inf).min(axis=0)
    board = (BOARD_M - origin[2]) / rays[..., 2]
    x, y = np.moveaxis(origin[:2] + rays[..., :2] * board[..., None], -1, 0)
    on_board = (x > BOARD_X[0]) & (x < BOARD_X[1]) & (y > BOARD_Y[0]) & (y < BOARD_Y[1])
    depth_m = np.where(on_board, board, depth_m)
    x, y, z = np.moveaxis(origin + rays * depth_m[..., None], -1, 0)
    paint = [
        0.5 + 0.2 * np.sin(a * x + b * y + c * z) + 0.15 * np.cos(b * x - c * y + a * z)
        for a, b, c in ((5.0, 3.0, 4.0), (3.0, 6.0, 2.0), (7.0, 2.0, 4.0))
    ]
    rgb = np.stack(paint, axis=-1).astype(np.float32)
    return Frame(index, index / 30.0, rgb, depth_m.astype(np.float32), camera)
