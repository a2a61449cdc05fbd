"""Two submaps of one small room, and the true motion between their frames."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from mapped_submap import MappedSubmap
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.codes import flat_code
from toolkit.semantics.options import SemanticLossWeights
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping import mapper as mapper_module
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.losses.semantic import SemanticLoss

QUICK = MapperOptions(first_iterations=4, iterations=6)


@dataclass(frozen=True)
class Scene:
    """Submaps made of different frames, each in the frame of its own first camera."""

    frames: list[Frame]
    target: Submap
    source: Submap
    T_target_source: NDArray[np.float64]


@functools.cache
def scene(
    target: tuple[int, ...] = (0, 4, 8, 12),
    source: tuple[int, ...] = (14, 10, 6),
    semantics: SemanticMapping | None = None,
) -> Scene:
    """Two submaps of the frames of these numbers."""
    frames, truth = tiny_room(16, 160, 120)
    poses = truth.T_world_camera
    return Scene(
        frames,
        submap_of(0, frames, poses, target, semantics),
        submap_of(1, frames, poses, source, semantics),
        se3.inverse(poses[target[0]]) @ poses[source[0]],
    )


@functools.cache
def classes() -> SemanticMapping:
    """Semantics of the room's classes, without levels."""
    tree = Taxonomy({"everything": list(CLASS_NAMES)}, classes=CLASS_NAMES)
    return SemanticMapping(SemanticLoss(flat_code(tree), SemanticLossWeights()))


def submap_of(
    number: int,
    frames: list[Frame],
    poses: NDArray[np.float64],
    numbers: Sequence[int],
    semantics: SemanticMapping | None = None,
) -> Submap:
    """A submap mapped from frames at their true poses."""
    mapper = MappedSubmap(QUICK, np.random.default_rng(number), semantics=semantics)
    T_submap_world = se3.inverse(poses[numbers[0]])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(mapper_module, "_MAX_ITERATIONS", QUICK.iterations)
        for place in numbers:
            mapper.add_keyframe(Keyframe.from_frame(frames[place], T_submap_world @ poses[place]))
    return Submap(
        number=number,
        T_world_submap=np.eye(4),
        gaussians=mapper.gaussians,
        keyframes=mapper.keyframes,
        descriptors=np.array([thumbnail(keyframe) for keyframe in mapper.keyframes]),
    )


def moved(submap: Submap, T_new_old: NDArray[np.float64]) -> Submap:
    """The same submap, expressed in another frame."""
    keyframes = [replace(k, T_map_camera=T_new_old @ k.T_map_camera) for k in submap.keyframes]
    gaussians = submap.gaussians.transformed(T_new_old)
    return replace(submap, gaussians=gaussians, keyframes=keyframes)


def seen_by(keyframe: Keyframe, camera: Camera) -> Keyframe:
    """A keyframe as another camera at the same place sees it, its images resampled."""
    own = keyframe.camera
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    u = ((x - camera.cx) / camera.fx * own.fx + own.cx).astype(np.float32)
    v = ((y - camera.cy) / camera.fy * own.fy + own.cy).astype(np.float32)
    rgb = keyframe.rgb.permute(1, 2, 0).contiguous().numpy().astype(np.float32) / 255.0
    rgb = cv2.remap(rgb, u, v, cv2.INTER_LINEAR).clip(0.0, 1.0)
    depth_m = cv2.remap(keyframe.depth_m.numpy(), u, v, cv2.INTER_NEAREST)
    frame = Frame(keyframe.index, keyframe.timestamp_s, rgb, depth_m, camera)
    return Keyframe.from_frame(frame, keyframe.T_map_camera, keyframe.exposure)


@functools.cache
def stranger() -> Keyframe:
    """A view of another room, at an unrelated pose."""
    frames, _ = tiny_room(1, 160, 120, seed=5)
    return Keyframe.from_frame(frames[0], motion(8, 1.0, 30.0))


def thumbnail(keyframe: Keyframe) -> NDArray[np.float32]:
    """A descriptor [192] of unit length: the image at 8x8 pixels, less its mean."""
    image = keyframe.rgb.permute(1, 2, 0).contiguous().numpy().astype(np.float32)
    small = cv2.resize(image, (8, 8), interpolation=cv2.INTER_AREA).ravel()
    small -= small.mean()
    return small / np.linalg.norm(small)


def error(T_found: NDArray[np.float64], T_true: NDArray[np.float64]) -> tuple[float, float]:
    """Distance in millimetres and angle in degrees."""
    difference = se3.inverse(T_true) @ T_found
    angle = se3.rotation_angle_rad(difference[:3, :3])
    return 1000.0 * float(np.linalg.norm(difference[:3, 3])), float(np.rad2deg(angle))


def motion(seed: int, metres: float, degrees: float) -> NDArray[np.float64]:
    """A motion of this length and angle in a random direction."""
    direction = np.random.default_rng(seed).normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return se3.exp(np.concatenate([metres * direction[0], np.deg2rad(degrees) * direction[1]]))
