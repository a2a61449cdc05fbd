"""Views beside the path that show what the path has shown: for judging a map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic.ray_casting import Scene
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera

_NEAREST_SURFACE_M = 0.4
_SEEN_SHARE = 0.999
_ATTEMPTS_PER_VIEW = 60
_COLUMNS = 40


def poses_off_the_path(
    scene: Scene, camera: Camera, T_world_camera: NDArray, count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Poses [up to count, 4, 4] at least a step away from the path.

    Nearly all that they see is also seen from the path, so that a map made on the path
    can be asked for them. Where no such pose is found there are fewer.
    """
    small = _small(camera)
    chosen = np.linspace(0, len(T_world_camera) - 1, min(len(T_world_camera), 80))
    witnesses = [(T, scene.render_depth(small, T)) for T in T_world_camera[chosen.astype(int)]]
    found: list[NDArray[np.float64]] = []
    for _ in range(count * _ATTEMPTS_PER_VIEW):
        if len(found) == count:
            break
        T = _beside(T_world_camera[rng.integers(len(T_world_camera))], rng)
        if scene.distance_m(T[None, :3, 3])[0] < _NEAREST_SURFACE_M:
            continue
        if _seen_share(scene, small, T, witnesses) >= _SEEN_SHARE:
            found.append(T)
    return np.stack(found) if found else np.empty((0, 4, 4))


def _small(camera: Camera) -> Camera:
    scale = min(1.0, _COLUMNS / camera.width)
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return camera.scaled(scale, scale, *size)


def _beside(T_world_camera: NDArray, rng: np.random.Generator) -> NDArray[np.float64]:
    """A pose some 10 to 30 cm and up to 15 degrees away, as level as the one it is beside."""
    T = T_world_camera.copy()
    direction = rng.standard_normal(3) * [1.0, 1.0, 0.5]
    T[:3, 3] += direction / np.linalg.norm(direction) * rng.uniform(0.1, 0.3)
    yaw = rng.uniform(-1.0, 1.0) * math.radians(15)
    pitch = rng.uniform(-1.0, 1.0) * math.radians(4)
    turn = se3.exp_so3(np.array([0.0, 0.0, yaw]))
    T[:3, :3] = turn @ T[:3, :3] @ se3.exp_so3(np.array([pitch, 0.0, 0.0]))
    return T


def _seen_share(
    scene: Scene, camera: Camera, T: NDArray, witnesses: list[tuple[NDArray, NDArray]]
) -> float:
    """Share of a view's pixels whose surface some witness sees as well."""
    depth = scene.render_depth(camera, T)
    points = se3.transform_points(T, camera.unproject(depth).reshape(-1, 3))
    seen = np.zeros(len(points), dtype=bool)
    for T_witness, witness_depth in witnesses:
        local = se3.transform_points(se3.inverse(T_witness), points)
        ahead = local[:, 2] > 0.1
        safe = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
        x, y = np.round(camera.project(safe)).astype(int).T
        ahead &= (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        x, y = np.where(ahead, x, 0), np.where(ahead, y, 0)
        # A coarse image: neighbours of a slanted surface differ by some per cent.
        seen |= ahead & (local[:, 2] < 1.05 * witness_depth[y, x] + 0.05)
    return float(seen.mean())
