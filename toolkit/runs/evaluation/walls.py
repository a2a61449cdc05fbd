"""Thickness of the surfaces of a map, which reveals duplicated surfaces.

Each opaque Gaussian is assigned to the nearest point of the ground-truth mesh, and the mesh is
divided into patches. The thickness of a patch is the spread of the signed offsets of its Gaussians
along the normal, from the 5th to the 95th percentile. A rigid shift of the complete map does not
change the thickness; misaligned submaps increase it by their misalignment.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.runs.evaluation.metrics import Metrics
from toolkit.splatting.gaussians.scene import GaussianScene

PATCH_M = 0.25
# Patches with fewer Gaussians are ignored.
_MIN_GAUSSIANS = 30
_MIN_OPACITY = 0.5
# Gaussians farther from the mesh are floaters.
_MAX_OFFSET_M = 0.5

WALL_CONVENTION = (
    f"of patches of {100 * PATCH_M:.0f} cm of the true mesh with at least {_MIN_GAUSSIANS} solid "
    "Gaussians: the spread of their offsets along the normal, 5th to 95th percentile; the "
    "median and the 95th percentile of the patches"
)


@dataclass(frozen=True)
class WallThickness:
    """Thickness of the patches [P] in metres, and the fraction of opaque Gaussians off surfaces."""

    patches_m: NDArray[np.float64]
    floaters: float

    def metrics(self) -> Metrics:
        """Return the metrics by name."""
        known = len(self.patches_m) > 0
        median, p95 = (
            (float(np.percentile(self.patches_m, p)) if known else None) for p in (50, 95)
        )
        return {
            "thickness_cm": None if median is None else 100.0 * median,
            "thickness_p95_cm": None if p95 is None else 100.0 * p95,
            "floaters_percent": 100.0 * self.floaters,
            "convention": WALL_CONVENTION,
        }


def wall_thickness(
    scene: GaussianScene, mesh: Path, T_world_map: NDArray[np.float64]
) -> WallThickness:
    """Compare a map with the ground-truth mesh of the scene.

    Args:
        scene: the map.
        mesh: file of the ground-truth mesh, in the world frame of the ground truth.
        T_world_map: [4, 4] pose of the map in the world.

    Raises:
        FormatError: the mesh cannot be read or is empty.
        DependencyError: Open3D cannot be loaded.
    """
    surface = _Surface(mesh)
    patches, offsets_m, count, near_count = [], [], 0, 0
    for part in scene.parts():
        opaque = part.select(part.opacities >= _MIN_OPACITY)
        points = opaque.transformed(T_world_map).means.numpy()
        closest, normals = surface.closest(points)
        offset_m = np.einsum("ij,ij->i", points - closest, normals).astype(np.float64)
        near = np.linalg.norm(points - closest, axis=1) <= _MAX_OFFSET_M
        # Degenerate triangles have no normal.
        valid = near & np.isfinite(offset_m)
        patches.append(_patch_keys(closest[valid], normals[valid]))
        offsets_m.append(offset_m[valid])
        count += len(points)
        near_count += int(near.sum())
    floaters = 1.0 - near_count / count if count else 0.0
    return WallThickness(_spreads(np.concatenate(patches), np.concatenate(offsets_m)), floaters)


class _Surface:
    """Nearest-point queries on the ground-truth mesh."""

    def __init__(self, mesh: Path) -> None:
        self._o3d = open3d()
        surface = self._o3d.t.io.read_triangle_mesh(str(mesh))
        if len(surface.vertex) == 0 or surface.triangle.indices.shape[0] == 0:
            raise FormatError(f"{mesh} contains no triangles; create the room again")
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(surface)

    def closest(
        self, points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the nearest points [N, 3] on the mesh and the normals [N, 3] there."""
        result = self._scene.compute_closest_points(
            self._o3d.core.Tensor(np.ascontiguousarray(points))
        )
        return result["points"].numpy(), result["primitive_normals"].numpy()


def _patch_keys(points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return patch identifiers [N] made of the grid cell and the direction of the normal."""
    cell = np.floor(points / PATCH_M).astype(np.int64) + (1 << 15)
    axis = np.abs(normals).argmax(axis=1)
    side = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    direction = 2 * axis + side
    keys = (cell[:, 0] << 40) | (cell[:, 1] << 24) | (cell[:, 2] << 8) | direction
    return keys.astype(np.int64)


def _spreads(patch: NDArray[np.int64], offset_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spread of the offsets of each patch with enough Gaussians."""
    order = np.lexsort((offset_m, patch))
    _, start, count = np.unique(patch[order], return_index=True, return_counts=True)
    enough = count >= _MIN_GAUSSIANS
    start, last = start[enough], count[enough] - 1
    ordered = offset_m[order]
    low, high = (ordered[start + np.rint(q * last).astype(np.int64)] for q in (0.05, 0.95))
    return np.asarray(high - low)
