"""Views as other cameras or careless users give them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera

Posed = tuple[Frame, NDArray[np.float64]]


def _turned(
    frame: Frame, pose: NDArray[np.float64], degrees: float, width: int, height: int
) -> Posed:
    """A view by a camera that is turned about its axis, as if it were not."""
    camera = frame.camera
    centre = (width / 2.0 - 0.5, height / 2.0 - 0.5)
    turn = cv2.getRotationMatrix2D((camera.cx, camera.cy), degrees, 1.0)
    turn[:, 2] += centre[0] - camera.cx, centre[1] - camera.cy

    def warped(image: NDArray) -> NDArray[np.float32]:
        values, flags = image.astype(np.float32), cv2.INTER_NEAREST
        return cv2.warpAffine(values, turn, (width, height), flags=flags).astype(np.float32)

    assert frame.labels is not None
    labels = warped(frame.labels).astype(np.int32)
    turned = Camera(camera.fx, camera.fy, *centre, width, height)
    return Frame(
        frame.index, frame.timestamp_s, warped(frame.rgb), warped(frame.depth_m), turned, labels
    ), pose


def _cut(frame: Frame, pose: NDArray[np.float64], rows: slice, columns: slice) -> Posed:
    """A part of a view."""
    camera, part = frame.camera, (rows, columns)
    assert frame.labels is not None
    rgb, depth_m = (np.ascontiguousarray(image[part]) for image in (frame.rgb, frame.depth_m))
    labels = np.ascontiguousarray(frame.labels[part])
    left, top = columns.start or 0, rows.start or 0
    height, width = depth_m.shape
    seen = Camera(camera.fx, camera.fy, camera.cx - left, camera.cy - top, width, height)
    return Frame(frame.index, frame.timestamp_s, rgb, depth_m, seen, labels), pose


def _street(frame: Frame, pose: NDArray[np.float64]) -> Posed:
    """A road between two rows of houses, below the sky; nothing of it has a class."""
    camera = frame.camera
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    road_m = _EYES_M / np.maximum(y, 1e-6)[:, None]
    houses_m = _ROAD_M / np.maximum(np.abs(x), 1e-6)[None]
    depth_m = np.minimum(road_m, houses_m)
    depth_m[(depth_m > _FARTHEST_M) | (-y[:, None] * houses_m > _ROOF_M)] = 0.0
    nothing = np.zeros(depth_m.shape, np.int32)
    return replace(frame, depth_m=depth_m.astype(np.float32), labels=nothing), pose


_EYES_M, _ROAD_M, _ROOF_M, _FARTHEST_M = 1.6, 7.0, 9.0, 40.0
# What a segmenter may meet: views of office0 as other cameras, or careless users, give them.
HARD_VIEWS: dict[str, Callable[[Frame, NDArray[np.float64]], Posed]] = {
    "as it is": lambda f, T: (f, T),
    "no floor in view": lambda f, T: _cut(f, T, slice(0, f.camera.height // 2), slice(None)),
    "close-up": lambda f, T: _cut(
        f, T, *(slice(3 * n // 8, 5 * n // 8) for n in (f.camera.height, f.camera.width))
    ),
    "camera turned by 30 degrees": lambda f, T: _turned(f, T, 30, f.camera.width, f.camera.height),
    "portrait, but told to be upright": lambda f, T: _turned(
        f, T, 90, f.camera.height, f.camera.width
    ),
    "depth ten times too large": lambda f, T: (replace(f, depth_m=f.depth_m * np.float32(10)), T),
    "depth ten times too small": lambda f, T: (replace(f, depth_m=f.depth_m / np.float32(10)), T),
    "a street": _street,
}
