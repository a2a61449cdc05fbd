"""How thick a map makes the surfaces that are there: a wall told twice is a thick one.

Each solid Gaussian belongs to the nearest point of the true mesh; the surface is cut into
patches, and a patch is as thick as the spread of its Gaussians' signed offsets along the
normal, from the 5th to the 95th percentile. A map that is shifted as a whole stays thin; one
whose submaps do not agree becomes as thick as they differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.evaluation.metrics import Metrics
from toolkit.gaussians.scene import GaussianScene
from toolkit.geometry.open3d_bridge import open3d

PATCH_M = 0.25
# Fewer Gaussians say nothing about a patch.
_FEWEST = 30
_LEAST_OPACITY = 0.5
# Farther off the mesh a Gaussian is a floater, and part of no wall.
_MOST_OFFSET_M = 0.5

WALL_CONVENTION = (
    f"of patches of {100 * PATCH_M:.0f} cm of the true mesh with at least {_FEWEST} solid "
    "Gaussians: the spread of their offsets along the normal, 5th to 95th percentile; the "
    "median and the 95th percentile of the patches"
)


@dataclass(frozen=True)
class WallThickness:
    """Thickness of the patches [P] in metres, and the share of solid Gaussians off all walls."""

    patches_m: NDArray[np.float64]
    floaters: float

    def metrics(self) -> Metrics:
        """Flat figures."""
        known = len(self.patches_m) > 0
        median, thick = (
            (float(np.percentile(self.patches_m, p)) if known else None) for p in (50, 95)
        )
        return {
            "wall_thickness_cm": None if median is None else 100.0 * median,
            "wall_thickness_p95_cm": None if thick is None else 100.0 * thick,
            "floaters_percent": 100.0 * self.floaters,
            "wall_thickness_convention": WALL_CONVENTION,
        }


def wall_thickness(
    scene: GaussianScene, mesh: Path, T_world_map: NDArray[np.float64]
) -> WallThickness:
    """Hold a map against the true mesh of the scene.

    Args:
        scene: the map.
        mesh: file of the true surface, in the world of the truth.
        T_world_map: [4, 4].

    Raises:
        FormatError: the mesh cannot be read or is empty.
        DependencyError: Open3D cannot be loaded.
    """
    surface = _Surface(mesh)
    patches, offsets_m, count, found = [], [], 0, 0
    for part in scene.parts():
        solid = part.select(part.opacities >= _LEAST_OPACITY)
        points = solid.transformed(T_world_map).means.numpy()
        closest, normals = surface.closest(points)
        offset_m = np.einsum("ij,ij->i", points - closest, normals).astype(np.float64)
        near = np.linalg.norm(points - closest, axis=1) <= _MOST_OFFSET_M
        # A triangle without area has no normal; its neighbours tell of the same wall.
        kept = near & np.isfinite(offset_m)
        patches.append(_patch_keys(closest[kept], normals[kept]))
        offsets_m.append(offset_m[kept])
        count += len(points)
        found += int(near.sum())
    floaters = 1.0 - found / count if count else 0.0
    return WallThickness(_spreads(np.concatenate(patches), np.concatenate(offsets_m)), floaters)


class _Surface:
    """The true mesh, to be asked for its nearest points."""

    def __init__(self, mesh: Path) -> None:
        self._o3d = open3d()
        surface = self._o3d.t.io.read_triangle_mesh(str(mesh))
        if len(surface.vertex) == 0 or surface.triangle.indices.shape[0] == 0:
            raise FormatError(f"{mesh} holds no triangles; make the room again")
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(surface)

    def closest(
        self, points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Nearest points [N, 3] of the mesh and the normals [N, 3] there."""
        found = self._scene.compute_closest_points(
            self._o3d.core.Tensor(np.ascontiguousarray(points))
        )
        return found["points"].numpy(), found["primitive_normals"].numpy()


def _patch_keys(points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.int64]:
    """A number [N] for the patch: its cell, and which way the surface faces there."""
    cell = np.floor(points / PATCH_M).astype(np.int64) + (1 << 15)
    axis = np.abs(normals).argmax(axis=1)
    side = np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] > 0
    facing = 2 * axis + side
    return ((cell[:, 0] << 40) | (cell[:, 1] << 24) | (cell[:, 2] << 8) | facing).astype(np.int64)


def _spreads(patch: NDArray[np.int64], offset_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Spread of the offsets of each patch that has enough of them."""
    order = np.lexsort((offset_m, patch))
    _, start, count = np.unique(patch[order], return_index=True, return_counts=True)
    kept = count >= _FEWEST
    start, last = start[kept], count[kept] - 1
    ordered = offset_m[order]
    low, high = (ordered[start + np.rint(q * last).astype(np.int64)] for q in (0.05, 0.95))
    return np.asarray(high - low)
