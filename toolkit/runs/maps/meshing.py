"""Meshes and point clouds of the Gaussians of a map, or of a subset of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import NearestNeighbors
from tqdm import tqdm

from toolkit.base.errors import SettingsError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.io.meshes import PosedDepth, TriangleMesh, fuse_views, write_points
from toolkit.runs.maps.finished import FinishedRun
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

# Minimum opacity of Gaussians that represent surfaces.
_MIN_OPACITY = 0.5
# Minimum silhouette (0-1) of rendered pixels that are fused.
_MIN_SILHOUETTE = 0.9

# A mesh of a room with smaller voxels does not fit in memory.
MIN_VOXEL_M = 0.001


@dataclass(frozen=True)
class MeshOptions:
    """Options of fusing a mesh from rendered views.

    Attributes:
        voxel_m: voxel size in metres, at least 0.001.
        max_depth_m: maximum fused depth in metres, > 0.
        every: interval of the run's poses that are rendered, >= 1.

    Raises:
        SettingsError: a value is out of range or not finite.
    """

    voxel_m: float
    max_depth_m: float
    every: int

    def __post_init__(self) -> None:
        for name in ("voxel_m", "max_depth_m", "every"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise SettingsError(f"{name} must be positive and finite, got {value}")
        if self.voxel_m < MIN_VOXEL_M:
            raise SettingsError(f"voxel_m must be at least {MIN_VOXEL_M} m, got {self.voxel_m}")


def write_opaque_points(path: Path, gaussians: GaussianCloud, origin_m: NDArray[np.float64]) -> int:
    """Write the centres of the opaque Gaussians as a point cloud.

    Args:
        path: the file.
        gaussians: the map of a run or a subset.
        origin_m: [3] is added to the centres.

    Returns:
        The number of points.

    Raises:
        ToolkitError: there are no opaque Gaussians, or the file cannot be written.
    """
    opaque = gaussians.select(gaussians.opacities >= _MIN_OPACITY)
    if len(opaque) == 0:
        raise ToolkitError(
            f"cannot write {path}: no Gaussian has an opacity of at least {_MIN_OPACITY}"
        )
    points_m = opaque.means.numpy().astype(np.float64) + origin_m
    write_points(path, points_m, opaque.colours.numpy())
    return len(opaque)


def surface_mesh(run: FinishedRun, gaussians: GaussianCloud, options: MeshOptions) -> TriangleMesh:
    """Fuse the surface of Gaussians from depth and colour rendered at the run's poses.

    Reconstruction from the centres was not chosen: ball pivoting leaves holes, Poisson
    reconstruction adds surfaces beyond open borders, and both need estimated normals.

    Args:
        run: supplies camera, poses and renderer.
        gaussians: the map of the run or a subset, rendered without the remaining Gaussians, which
            therefore do not occlude it.

    Raises:
        ToolkitError: no surface is within the maximum depth.
    """
    views = _views(run, gaussians, options.every)
    return fuse_views(views, options.voxel_m, options.max_depth_m)


def part_mesh(run: FinishedRun, part: GaussianCloud, options: MeshOptions) -> TriangleMesh:
    """Fuse the surface of a subset of a run's Gaussians, without triangles far from all of them.

    Such triangles are artefacts. If a thin object is observed from both sides, which occurs when
    occluders are not rendered, the signed distance has another zero crossing some voxels in front
    of the surface. At edges, depths of two surfaces are mixed.

    Raises:
        ToolkitError: no surface is within the maximum depth, or the mesh is empty.
    """
    mesh = surface_mesh(run, part, options)
    search = NearestNeighbors(n_neighbors=1).fit(part.means.numpy())
    distance_m, nearest = (column[:, 0] for column in search.kneighbors(mesh.vertices_m))
    max_distance_m = 2.0 * (options.voxel_m + part.radii_m.numpy()[nearest])
    kept = (distance_m <= max_distance_m)[mesh.triangles].all(axis=1)
    if not kept.any():
        raise ToolkitError(
            "the selected Gaussians are too thin or too few for a mesh; decrease the voxel size"
        )
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    return TriangleMesh(
        mesh.vertices_m[used],
        mesh.colours[used],
        triangles.reshape(-1, 3).astype(np.int32),
    )


def _views(run: FinishedRun, gaussians: GaussianCloud, every: int) -> Iterator[PosedDepth]:
    camera = run.camera
    frames = run.tracked[::every]
    for frame in tqdm(frames, unit="view", disable=None):
        rendered = render_surface(
            backend(run.settings.backend),
            gaussians,
            camera,
            se3.inverse(frame.T_map_camera),
            RenderOptions(_MIN_SILHOUETTE),
        )
        rgb = np.clip(rendered.output.colour.numpy(), 0.0, 1.0)
        yield PosedDepth(camera, frame.T_map_camera, rgb, rendered.depth_m.numpy())
