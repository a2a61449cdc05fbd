"""Frames of a small room with their true poses, and frames of what never was there."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from mapped_submap import MappedSubmap
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.slam.mapping.options import MapperOptions
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.options import SeedingOptions
from toolkit.splatting.gaussians.seeding import seed
from toolkit.splatting.rendering import RenderOptions, backend, render, render_surface


@dataclass(frozen=True)
class Room:
    """Frames, and their true poses in the first camera's frame."""

    frames: list[Frame]
    T_map_camera: NDArray[np.float64]


@functools.cache
def first_steps(count: int = 6, width: int = 160, height: int = 120) -> Room:
    frames, truth = tiny_room(count, width, height)
    T_map_world = se3.inverse(truth.T_world_camera[0])
    return Room(frames, T_map_world @ truth.T_world_camera)


@functools.cache
def map_of_first_frame() -> GaussianCloud:
    """A map of the first frame alone."""
    room, mapper = first_steps(), MappedSubmap(MapperOptions(first_iterations=40))
    mapper.add_keyframe(Keyframe.from_frame(room.frames[0], room.T_map_camera[0]))
    return mapper.gaussians


@functools.cache
def opaque_map_of_first_frame() -> GaussianCloud:
    """The same as the papers seed it: one wide Gaussian per pixel leaves no holes in their mask."""
    frame = first_steps().frames[0]
    everywhere = np.ones_like(frame.depth_m, dtype=bool)
    return seed(frame, np.eye(4), everywhere, SeedingOptions(1.0, 0.95, max_cell=1))


def distance_mm(T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> float:
    """Distance of two camera centres in millimetres."""
    return 1000.0 * float(np.linalg.norm((se3.inverse(T_a) @ T_b)[:3, 3]))


def angle_deg(T_a: NDArray[np.float64], T_b: NDArray[np.float64]) -> float:
    """Angle between two cameras in degrees."""
    return float(np.rad2deg(se3.rotation_angle_rad((se3.inverse(T_a) @ T_b)[:3, :3])))


def assert_same_place(
    T_found: NDArray[np.float64], T_true: NDArray[np.float64], mm: float = 1.0, deg: float = 0.05
) -> None:
    assert distance_mm(T_found, T_true) < mm
    assert angle_deg(T_found, T_true) < deg


def small_motion(seed: int, metres: float, degrees: float) -> NDArray[np.float64]:
    """A motion of this length and angle in a random direction."""
    direction = np.random.default_rng(seed).normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return se3.exp(np.concatenate([metres * direction[0], np.deg2rad(degrees) * direction[1]]))


def ideal_frame(gaussians: GaussianCloud, like: Frame, T_map_camera: NDArray[np.float64]) -> Frame:
    """What the map itself shows there: a frame whose pose is known exactly."""
    view = render_surface(
        backend(), gaussians, like.camera, se3.inverse(T_map_camera), RenderOptions(0.9)
    )
    rgb = view.output.colour.clamp(0.0, 1.0).contiguous().numpy()
    return replace(like, rgb=rgb, depth_m=view.depth_m.numpy())


def composited_frame(
    gaussians: GaussianCloud, like: Frame, T_map_camera: NDArray[np.float64]
) -> Frame:
    """The same with the mean depth of compositing, which the papers' loss compares."""
    drawn = render(gaussians, like.camera, se3.inverse(T_map_camera))
    solid = drawn.silhouette.numpy() > 0.9
    depth = np.where(solid, drawn.depth_m.numpy(), np.float32(0))
    rgb = drawn.colour.clamp(0.0, 1.0).contiguous().numpy()
    return replace(like, rgb=rgb, depth_m=depth)


def blank_frame(like: Frame) -> Frame:
    """A grey wall before the lens."""
    flat = np.full_like(like.depth_m, 0.5)
    return replace(like, rgb=np.full_like(like.rgb, 0.5), depth_m=flat)


def blind_frame(like: Frame) -> Frame:
    """Colour as it was, and no depth at all."""
    return replace(like, depth_m=np.zeros_like(like.depth_m))


def dead_sensor_frame(like: Frame) -> Frame:
    """Depth as it was, and no number in the colour: what a division by zero upstream leaves."""
    return replace(like, rgb=np.full_like(like.rgb, np.nan))


def frame_from_elsewhere(like: Frame) -> Frame:
    """Another room, seen from another place."""
    frames, _ = tiny_room(1, *like.camera.size, seed=5)
    upside_down = frames[0].rgb[::-1, ::-1].copy(), frames[0].depth_m[::-1, ::-1].copy()
    return replace(like, rgb=upside_down[0], depth_m=1.7 * upside_down[1])
