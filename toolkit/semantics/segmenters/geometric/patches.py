"""Planar patches of a surface grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.open3d_bridge import open3d
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid

# Open3D looks for patches among about so many points.
_POINTS = 5000
_NEIGHBOURS = 10
_LEAST_POINTS = 12
_LEAST_EDGE_M = 0.1
# What of the grid belongs to a patch: beside its box, off its plane (m, and share of depth),
# and by its normal.
_MARGIN_M = 0.05
_OFF_M, _OFF_SHARE = 0.025, 0.01
_LEAST_COSINE = 0.85
# Of depth, up and down.
_RIPPLE, _GOLDEN_RATIO = 1.5e-3, 0.6180339887498949


@dataclass(frozen=True)
class Patch:
    """A piece of a plane, in camera coordinates.

    Attributes:
        normal: [3] float64 of unit length, towards the camera.
        distance_m: of the plane's points x, normal . x; negative.
        cells: [h, w], the cells of the grid that lie on it.
    """

    normal: NDArray[np.float64]
    distance_m: float
    cells: NDArray[np.bool_]


def planar_patches(grid: SurfaceGrid) -> list[Patch]:
    """The planar patches of a grid, found by Open3D (Araujo and Oliveira 2020).

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    stride = max(1, round((grid.valid.size / _POINTS) ** 0.5))
    chosen = grid.oriented[::stride, ::stride]
    if chosen.sum() < _LEAST_POINTS:
        return []
    o3d = open3d()
    cloud = o3d.geometry.PointCloud()
    points = _rippled(grid.points[::stride, ::stride][chosen].astype(np.float64))
    normals = grid.normals[::stride, ::stride][chosen].astype(np.float64)
    cloud.points = o3d.utility.Vector3dVector(points)
    cloud.normals = o3d.utility.Vector3dVector(normals)
    boxes = cloud.detect_planar_patches(
        normal_variance_threshold_deg=60,
        coplanarity_deg=75,
        outlier_ratio=0.75,
        min_plane_edge_length=_LEAST_EDGE_M,
        min_num_points=_LEAST_POINTS,
        search_param=o3d.geometry.KDTreeSearchParamKNN(knn=_NEIGHBOURS),
    )
    found: list[Patch] = []
    free = grid.oriented.copy()
    for box in sorted(boxes, key=lambda b: -float(np.prod(np.asarray(b.extent)[:2]))):
        core = _in_box(grid, box) & free
        if core.sum() < _LEAST_POINTS:
            continue
        cells = _grown(grid, core, free)
        found.append(Patch(*_fitted(grid, cells), cells))
        free &= ~cells
    return found


def _rippled(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points moved a little along their rays, always alike.

    Open3D measures planes by the spread about them and finds none where there is no spread, as
    in depth without noise.
    """
    share = np.arange(len(points)) * _GOLDEN_RATIO % 1.0
    return np.asarray(points * (1.0 + _RIPPLE * (2.0 * share - 1.0))[:, None])


def _in_box(grid: SurfaceGrid, box: Any) -> NDArray[np.bool_]:
    """The cells in a box whose third axis is the normal."""
    R, extent_m = np.asarray(box.R).astype(np.float32), np.asarray(box.extent)
    centre = np.asarray(box.center).astype(np.float32)
    normal = R[:, 2] if R[:, 2] @ centre < 0 else -R[:, 2]
    local = (grid.points - centre) @ R
    cells = grid.oriented & (grid.normals @ normal > _LEAST_COSINE)
    cells &= np.abs(local[..., 2]) < _OFF_M + _OFF_SHARE * grid.depth_m
    for axis in (0, 1):
        cells &= np.abs(local[..., axis]) < extent_m[axis] / 2 + _MARGIN_M
    return cells


def _grown(
    grid: SurfaceGrid, core: NDArray[np.bool_], free: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The free cells on a core's plane that hang together with it: boxes end too soon."""
    normal, distance_m = _fitted(grid, core)
    off = np.abs(grid.points @ normal.astype(np.float32) - np.float32(distance_m))
    cells = free & (off < _OFF_M + _OFF_SHARE * grid.depth_m)
    cells &= grid.normals @ normal.astype(np.float32) > _LEAST_COSINE
    count, pieces = cv2.connectedComponents(cells.astype(np.uint8), connectivity=4)
    joined = np.bincount(pieces[core], minlength=count) > 0
    joined[0] = False
    return core | joined[pieces]


def _fitted(grid: SurfaceGrid, cells: NDArray[np.bool_]) -> tuple[NDArray[np.float64], float]:
    """Normal [3] and distance of the plane through some cells."""
    normal = grid.normals[cells].sum(axis=0, dtype=np.float64)
    normal /= np.linalg.norm(normal)
    return normal, float(np.median(grid.points[cells] @ normal))
