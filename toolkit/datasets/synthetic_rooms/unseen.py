"""Test views off the camera path that show surfaces seen from the path."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.synthetic_rooms.ray_casting import Scene

_NEAREST_SURFACE_M = 0.4
_SEEN_SHARE = 0.999
_ATTEMPTS_PER_VIEW = 60
_COLUMNS = 40


def poses_off_the_path(
    scene: Scene, camera: Camera, T_world_camera: NDArray, count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return up to `count` poses [K, 4, 4] beside the path.

    Nearly all surfaces in these views are also seen from the path, so that a map built along the
    path can be evaluated on them. Fewer poses are returned if not enough are found.
    """
    small = _small(camera)
    chosen = np.linspace(0, len(T_world_camera) - 1, min(len(T_world_camera), 80))
    references = [(T, scene.render_depth(small, T)) for T in T_world_camera[chosen.astype(int)]]
    found: list[NDArray[np.float64]] = []
    for _ in range(count * _ATTEMPTS_PER_VIEW):
        if len(found) == count:
            break
        T = _beside(T_world_camera[rng.integers(len(T_world_camera))], rng)
        if scene.distance_m(T[None, :3, 3])[0] < _NEAREST_SURFACE_M:
            continue
        if _visible_fraction(scene, small, T, references) >= _SEEN_SHARE:
            found.append(T)
    return np.stack(found) if found else np.empty((0, 4, 4))


def _small(camera: Camera) -> Camera:
    scale = min(1.0, _COLUMNS / camera.width)
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return camera.scaled(scale, scale, *size)


def _beside(T_world_camera: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a random pose at 10 to 30 cm and up to 15 degrees of yaw, without additional roll."""
    T = T_world_camera.copy()
    direction = rng.standard_normal(3) * [1.0, 1.0, 0.5]
    T[:3, 3] += direction / np.linalg.norm(direction) * rng.uniform(0.1, 0.3)
    yaw = rng.uniform(-1.0, 1.0) * math.radians(15)
    pitch = rng.uniform(-1.0, 1.0) * math.radians(4)
    turn = se3.exp_so3(np.array([0.0, 0.0, yaw]))
    T[:3, :3] = turn @ T[:3, :3] @ se3.exp_so3(np.array([pitch, 0.0, 0.0]))
    return T


def _visible_fraction(
    scene: Scene, camera: Camera, T: NDArray, references: list[tuple[NDArray, NDArray]]
) -> float:
    """Return the fraction of a view's pixels whose surface is visible in a reference view."""
    depth = scene.render_depth(camera, T)
    points = se3.transform_points(T, camera.unproject(depth).reshape(-1, 3))
    seen = np.zeros(len(points), dtype=bool)
    for T_reference, reference_depth in references:
        local = se3.transform_points(se3.inverse(T_reference), points)
        ahead = local[:, 2] > 0.1
        safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
        x, y = np.round(camera.project(safe)).astype(int).T
        ahead &= (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        x, y = np.where(ahead, x, 0), np.where(ahead, y, 0)
        # Images are coarse: depths of neighbouring pixels on slanted surfaces differ by a few %.
        seen |= ahead & (local[:, 2] < 1.05 * reference_depth[y, x] + 0.05)
    return float(seen.mean())
