"""View-independent lighting, computed once at the vertices.

It consists of ceiling lamps with soft shadows and ambient light with ambient occlusion.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.datasets.synthetic_rooms.patches import TexturedPatch

_AMBIENT = 0.62
_DIRECT = 0.75
# Maximum distance of ambient occlusion.
_AMBIENT_REACH_M = 1.2
_LAMP_EDGE_M = 0.7
_CLEARANCE_M = 0.012


def vertex_light(
    patches: list[TexturedPatch], lamps_m: NDArray[np.float64], scene: Any
) -> list[NDArray[np.floating]]:
    """Compute the brightness [R, C] at the points of every patch, about 1 where well lit.

    Args:
        patches: surfaces in the world.
        lamps_m: [L, 3] centres of square ceiling lamps, metres.
        scene: Open3D RaycastingScene of the same surfaces.
    """
    normals = np.concatenate([patch.normals().reshape(-1, 3) for patch in patches])
    points = np.concatenate([_off_the_border(patch.points).reshape(-1, 3) for patch in patches])
    points = points + _CLEARANCE_M * normals
    light = _AMBIENT * _openness(points, normals, scene)
    light = light + _DIRECT * _lamp_light(points, normals, lamps_m, scene)
    brightness = np.clip(light, 0.3, 1.25).astype(np.float32)
    sizes = [patch.points.shape[:2] for patch in patches]
    ends = np.cumsum([rows * columns for rows, columns in sizes])[:-1]
    return [
        part.reshape(size) for part, size in zip(np.split(brightness, ends), sizes, strict=True)
    ]


def _off_the_border(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move border points slightly inwards, because corner points belong to two surfaces."""
    points = points.copy()
    for axis in (0, 1):
        rows = np.moveaxis(points, axis, 0)
        for border, inner in ((0, 1), (-1, -2)):
            step = rows[inner] - rows[border]
            length = np.linalg.norm(step, axis=-1, keepdims=True)
            rows[border] += step * np.minimum(0.3, 0.025 / np.maximum(length, 1e-9))
    return points


def _distances(origins: NDArray, directions: NDArray, scene: Any) -> NDArray[np.float32]:
    """Cast rays; return the hit distances [N] in units of the directions' length, or inf."""
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    hits = scene.cast_rays(open3d().core.Tensor.from_numpy(rays), nthreads=1)
    return np.asarray(hits["t_hit"].numpy())


def _openness(points: NDArray, normals: NDArray, scene: Any) -> NDArray[np.float64]:
    """Compute the cosine-weighted unoccluded fraction [N] of the hemisphere."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, normals)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    other = np.cross(normals, side)
    directions = _hemisphere(24)
    total = np.zeros(len(points))
    for a, b, c in directions:
        away = a * side + b * other + c * normals
        free = _distances(points, away, scene) / _AMBIENT_REACH_M
        total += np.clip(free, 0.0, 1.0)
    return 0.25 + 0.75 * total / len(directions)


def _hemisphere(count: int) -> NDArray[np.float64]:
    """Return directions [count, 3] around +z with density cos(angle), on a golden spiral."""
    number = np.arange(count) + 0.5
    radius = np.sqrt(number / count)
    angle = number * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=-1
    )


def _lamp_light(
    points: NDArray, normals: NDArray, lamps_m: NDArray, scene: Any
) -> NDArray[np.float64]:
    """Compute Lambertian light [N] of square lamps, with four samples each for soft shadows."""
    half = _LAMP_EDGE_M / 2
    total = np.zeros(len(points))
    for lamp in np.asarray(lamps_m, dtype=float).reshape(-1, 3):
        for dx, dy in ((-half, -half), (-half, half), (half, -half), (half, half)):
            towards = lamp + np.array([dx, dy, 0.0]) - points
            distance = np.linalg.norm(towards, axis=1)
            cosine = np.einsum("ij,ij->i", normals, towards) / np.maximum(distance, 1e-9)
            lit = np.flatnonzero((cosine > 0.0) & (distance < 6.0))
            free = _distances(points[lit], towards[lit], scene) >= 0.999
            # Light decreases with distance, but slowly, so that corners are not black.
            strength = cosine[lit] * free / (1.0 + (distance[lit] / 3.0) ** 2)
            total[lit] += 0.25 * strength
    return total
