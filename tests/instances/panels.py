"""Two panels side by side, seen by a camera that moves along them: objects that touch."""

from __future__ import annotations

import numpy as np
import torch

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker

CAMERA = Camera(fx=80.0, fy=80.0, cx=79.5, cy=59.5, width=160, height=120)
DISTANCE_M = 2.0
LEFT, RIGHT = 1, 2


def keyframe(index: int, shift_m: float = 0.0, shape: tuple[int, int] = (120, 160)) -> Keyframe:
    """A view of the panels from a place along them."""
    T_map_camera = np.eye(4)
    T_map_camera[0, 3] = shift_m
    return Keyframe(
        index=index,
        timestamp_s=index / 10.0,
        T_map_camera=T_map_camera,
        rgb=torch.full((3, *shape), 128, dtype=torch.uint8),
        depth_m=torch.full(shape, DISTANCE_M),
        camera=CAMERA,
        exposure=IDENTITY,
        points=np.zeros((0, 3), np.float32),
    )


def panel_image(shift_m: float = 0.0) -> np.ndarray:
    """Which panel each pixel shows: the border is at x = 0."""
    x = (np.arange(160) - CAMERA.cx) / CAMERA.fx * DISTANCE_M + shift_m
    return np.tile(np.where(x < 0, LEFT, RIGHT), (120, 1))


class Scripted:
    """Masks given by a list of images of ids, or of masks, by frame index."""

    def __init__(self, images: list) -> None:
        self.images = images

    def masks(self, frame: Keyframe) -> InstanceMasks | None:
        image = self.images[frame.index]
        return image if image is None or isinstance(image, InstanceMasks) else of_ids(image)


def of_ids(image: np.ndarray) -> InstanceMasks:
    return InstanceMasks.of_ids(image)


def tracked(images: list, shifts_m: list[float] | None = None, **options) -> InstanceTracker:
    """A tracker that has seen all images, in one submap."""
    tracker = InstanceTracker(InstanceOptions(**options), Scripted(images))
    keyframes: list[Keyframe] = []
    for index, shift_m in enumerate(shifts_m or [0.0] * len(images)):
        keyframes.append(keyframe(index, shift_m))
        tracker.update(0, keyframes)
    return tracker


def current_objects(tracker: InstanceTracker, index: int) -> list[int]:
    """The current objects of the masks of a keyframe."""
    record = next(record for record in tracker.records if record.index == index)
    return tracker.table()[record.objects].tolist()
