"""Planar patches of a surface grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid

# Approximate number of points in which Open3D detects patches.
_POINTS = 2500
_NEIGHBOURS = 10
_MIN_POINTS = 12
_MIN_EDGE_M = 0.1
# A cell belongs to a patch within this margin of its box, within this distance of its plane
# (constant part in metres, and fraction of depth), and above this cosine between the normals.
_MARGIN_M = 0.05
_DISTANCE_M, _DISTANCE_FRACTION = 0.025, 0.01
_MIN_COSINE = 0.85
# Amplitude of the depth perturbation as a fraction of depth.
_PERTURBATION, _GOLDEN_RATIO = 1.5e-3, 0.6180339887498949


@dataclass(frozen=True)
class PlanarPatch:
    """A planar patch in camera coordinates.

    Attributes:
        normal: [3] float64 unit normal, towards the camera.
        distance_m: signed distance normal . x of the plane's points x; negative.
        cells: [h, w] mask of the cells of the grid on the patch.
    """

    normal: NDArray[np.float64]
    distance_m: float
    cells: NDArray[np.bool_]


def planar_patches(grid: SurfaceGrid, points: int = _POINTS) -> list[PlanarPatch]:
    """Detect the planar patches of a grid with Open3D (Araujo and Oliveira 2020).

    Args:
        points: approximate number of cells in which they are detected.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    stride = max(1, round((grid.valid.size / points) ** 0.5))
    chosen = grid.oriented[::stride, ::stride]
    if chosen.sum() < _MIN_POINTS:
        return []
    o3d = open3d()
    cloud = o3d.geometry.PointCloud()
    places = _perturbed(grid.points[::stride, ::stride][chosen].astype(np.float64))
    normals = grid.normals[::stride, ::stride][chosen].astype(np.float64)
    cloud.points = o3d.utility.Vector3dVector(places)
    cloud.normals = o3d.utility.Vector3dVector(normals)
    boxes = cloud.detect_planar_patches(
        normal_variance_threshold_deg=60,
        coplanarity_deg=75,
        outlier_ratio=0.75,
        min_plane_edge_length=_MIN_EDGE_M,
        min_num_points=_MIN_POINTS,
        search_param=o3d.geometry.KDTreeSearchParamKNN(knn=_NEIGHBOURS),
    )
    found: list[PlanarPatch] = []
    free = grid.oriented.copy()
    for box in sorted(boxes, key=lambda b: -float(np.prod(np.asarray(b.extent)[:2]))):
        core = _in_box(grid, box) & free
        if core.sum() < _MIN_POINTS:
            continue
        cells = _grown(grid, core, free)
        found.append(PlanarPatch(*_fitted(grid, cells), cells))
        free &= ~cells
    return found


def _perturbed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Perturb points slightly along their rays, by a deterministic low-discrepancy sequence.

    Open3D evaluates planes by the variance of the points and detects none if the variance is zero,
    as in depth without noise.
    """
    sequence = np.arange(len(points)) * _GOLDEN_RATIO % 1.0
    return np.asarray(points * (1.0 + _PERTURBATION * (2.0 * sequence - 1.0))[:, None])


def _in_box(grid: SurfaceGrid, box: Any) -> NDArray[np.bool_]:
    """Return the cells inside a box whose third axis is the normal."""
    R, extent_m = np.asarray(box.R).astype(np.float32), np.asarray(box.extent)
    centre = np.asarray(box.center).astype(np.float32)
    normal = R[:, 2] if R[:, 2] @ centre < 0 else -R[:, 2]
    similar = np.flatnonzero(
        grid.oriented.reshape(-1) & (_along(grid.normals, normal) > _MIN_COSINE)
    )
    points = grid.points.reshape(-1, 3).take(similar, axis=0)
    local = np.abs((points - centre) @ R)
    inside = local[:, 2] < _DISTANCE_M + _DISTANCE_FRACTION * points[:, 2]
    for axis in (0, 1):
        inside &= local[:, axis] < extent_m[axis] / 2 + _MARGIN_M
    cells = np.zeros(grid.valid.shape, bool)
    cells.reshape(-1)[similar[inside]] = True
    return cells


def _along(vectors: NDArray[np.float32], direction: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the components [h * w] of vectors [h, w, 3] along a direction [3]."""
    # One product: NumPy would multiply each row of a three-dimensional array separately.
    return np.asarray(vectors.reshape(-1, 3) @ direction)


def _grown(
    grid: SurfaceGrid, core: NDArray[np.bool_], free: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Extend a core by the connected free cells on its plane; Open3D's boxes are too small."""
    normal, distance_m = _fitted(grid, core)
    direction = normal.astype(np.float32)
    offset = np.abs(_along(grid.points, direction) - np.float32(distance_m)).reshape(free.shape)
    cells = free & (offset < _DISTANCE_M + _DISTANCE_FRACTION * grid.depth_m)
    cells &= _along(grid.normals, direction).reshape(free.shape) > _MIN_COSINE
    count, pieces = cv2.connectedComponents(cells.astype(np.uint8), connectivity=4)
    joined = np.bincount(pieces[core], minlength=count) > 0
    joined[0] = False
    return core | joined[pieces]


def _fitted(grid: SurfaceGrid, cells: NDArray[np.bool_]) -> tuple[NDArray[np.float64], float]:
    """Return the normal [3] and distance of the plane through some cells."""
    chosen = np.flatnonzero(cells)
    normal = grid.normals.reshape(-1, 3).take(chosen, axis=0).sum(axis=0, dtype=np.float64)
    normal /= np.linalg.norm(normal)
    return normal, float(np.median(grid.points.reshape(-1, 3).take(chosen, axis=0) @ normal))
