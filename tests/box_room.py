"""A room of boxes whose depth and classes are known exactly, from any pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera

FLOOR, WALL, CEILING, SURFACE, OBJECT = 1, 2, 3, 4, 5
CAMERA = Camera(128.0, 128.0, 79.5, 59.5, 160, 120)

# Metres, z up: the room stands on z = 0.
ROOM = np.array([[-2.5, -2.0, 0.0], [2.5, 2.0, 2.5]])
TABLE = np.array([[-0.7, 0.5, 0.70], [0.7, 1.3, 0.75]])
CUPBOARD = np.array([[1.9, -1.2, 0.0], [2.5, 0.2, 2.0]])
CRATE = np.array([[-2.2, 1.2, 0.0], [-1.6, 1.8, 0.5]])
BOXES = (TABLE, CUPBOARD, CRATE)


@dataclass(frozen=True)
class LabelledView:
    """A frame with its pose and the true classes [H, W]."""

    frame: Frame
    T_world_camera: NDArray[np.float64]
    classes: NDArray[np.int64]


def looking(
    eye: tuple[float, float, float], at: tuple[float, float, float], roll_deg: float = 0.0
) -> NDArray[np.float64]:
    """T_world_camera [4, 4] of a camera at `eye` that looks at a point."""
    forward = np.subtract(at, eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    upright = np.stack([right, np.cross(forward, right), forward], axis=1)
    roll = se3.exp_so3(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))
    return se3.from_rotation_translation(upright @ roll, np.array(eye))


def see(
    T_world_camera: NDArray[np.float64], camera: Camera = CAMERA, index: int = 0
) -> LabelledView:
    """What an ideal camera sees there."""
    directions = camera.rays() @ T_world_camera[:3, :3].T
    eye = T_world_camera[:3, 3]
    depth, side = _leave(ROOM, eye, directions)
    classes = np.choose(side, [WALL, WALL, WALL, WALL, FLOOR, CEILING])
    for box in BOXES:
        near, side = _enter(box, eye, directions)
        hit = near < depth
        depth = np.where(hit, near, depth)
        classes = np.where(hit, np.where(side == 5, SURFACE, OBJECT), classes)
    rgb = np.zeros((*depth.shape, 3), np.float32)
    frame = Frame(index, index / 30.0, rgb, depth.astype(np.float32), camera)
    return LabelledView(frame, T_world_camera, classes)


def _crossings(box: NDArray, eye: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
    """Depths [H, W, 3] at which rays cross the lower and the upper sides of a box."""
    with np.errstate(divide="ignore"):
        return (box[0] - eye) / directions, (box[1] - eye) / directions


def _leave(box: NDArray, eye: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
    """Depth at which rays leave a box that they start in, and the side (axis, then upper)."""
    lower, upper = _crossings(box, eye, directions)
    far = np.maximum(lower, upper)
    axis = far.argmin(axis=-1)
    took_upper = np.take_along_axis(upper > lower, axis[..., None], axis=-1)[..., 0]
    return far.min(axis=-1), 2 * axis + took_upper


def _enter(box: NDArray, eye: NDArray, directions: NDArray) -> tuple[NDArray, NDArray]:
    """Depth at which rays meet a box, infinite if they pass it, and the side."""
    lower, upper = _crossings(box, eye, directions)
    near, far = np.minimum(lower, upper), np.maximum(lower, upper)
    axis = near.argmax(axis=-1)
    took_upper = np.take_along_axis(upper < lower, axis[..., None], axis=-1)[..., 0]
    depth = near.max(axis=-1)
    hit = (depth > 0) & (depth < far.min(axis=-1))
    return np.where(hit, depth, np.inf), 2 * axis + took_upper


def walk(count: int = 12, roll_deg: float = 0.0, camera: Camera = CAMERA) -> list[LabelledView]:
    """A turn on the spot, once around, looking a little down."""
    views = []
    for index, angle in enumerate(np.linspace(0.0, 2 * np.pi, count, endpoint=False)):
        eye = (-0.2 + 0.1 * np.cos(angle), -0.6, 1.5)
        at = (eye[0] + 2 * np.sin(angle), eye[1] + 2 * np.cos(angle), 0.9)
        views.append(see(looking(eye, at, roll_deg), camera, index))
    return views
