"""Point clouds and meshes of a map, or of some of its Gaussians."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sklearn.neighbors import NearestNeighbors
from tqdm import tqdm

from toolkit.errors import FormatError, SettingsError, ToolkitError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.io.meshes import DepthView, TriangleMesh, fuse_views, write_points
from toolkit.rendering import RenderOptions, backend, render_surface
from toolkit.runs.finished import FinishedRun

# Gaussians thinner than this are haze, not surface.
_LEAST_OPACITY = 0.5
# Rendered pixels thinner than this show no surface.
_MIN_SILHOUETTE = 0.9

# A mesh of a room with smaller voxels does not fit in memory.
MIN_VOXEL_M = 0.001


@dataclass(frozen=True)
class MeshOptions:
    """How a mesh is fused from renders.

    Attributes:
        voxel_m: edge of a voxel, metres.
        max_depth_m: farthest depth that enters, metres.
        every: of the run's poses, every n-th is drawn.

    Raises:
        SettingsError: one of them is not positive and finite, or the voxels are below 1 mm.
    """

    voxel_m: float
    max_depth_m: float
    every: int

    def __post_init__(self) -> None:
        for name in ("voxel_m", "max_depth_m", "every"):
            value = getattr(self, name)
            if not 0 < value < math.inf:
                raise SettingsError(f"--{name.replace('_', '-')} must be positive, got {value}")
        if self.voxel_m < MIN_VOXEL_M:
            raise SettingsError(f"--voxel-m must be at least {MIN_VOXEL_M} m, got {self.voxel_m}")


def check_output(option: str, path: Path, suffixes: Sequence[str]) -> None:
    """Check the name of a file before the work that it is to hold.

    Raises:
        FormatError: its ending is another, or its folder does not exist.
    """
    if path.suffix not in suffixes:
        raise FormatError(f"{option} {path}: the name must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise FormatError(f"{option} {path}: there is no folder {path.parent}; make it")


def write_solid_points(path: Path, gaussians: GaussianCloud) -> int:
    """Write the centres of the Gaussians that are no haze as a point cloud.

    Returns:
        how many they are.

    Raises:
        ToolkitError: all are haze, or the file cannot be written.
    """
    solid = gaussians.select(gaussians.opacities >= _LEAST_OPACITY)
    if len(solid) == 0:
        raise ToolkitError(f"cannot write {path}: none of the Gaussians is solid")
    write_points(path, solid.means.numpy(), solid.colours.numpy())
    return len(solid)


def surface_mesh(run: FinishedRun, gaussians: GaussianCloud, options: MeshOptions) -> TriangleMesh:
    """The surface of Gaussians, fused from their depth and colour at the run's poses.

    Fused rather than spanned between the centres: ball pivoting leaves holes, Poisson's method
    adds skirts around open borders, and both would have to guess the normals.

    Args:
        run: gives camera, poses and renderer.
        gaussians: the run's map or a part of it, drawn alone: what would hide it is not there.

    Raises:
        ToolkitError: nothing is near enough.
    """
    views = _views(run, gaussians, options.every)
    return fuse_views(views, options.voxel_m, options.max_depth_m)


def part_mesh(run: FinishedRun, part: GaussianCloud, options: MeshOptions) -> TriangleMesh:
    """`surface_mesh` of some of a run's Gaussians, without what lies off all of them.

    Where a thin thing is seen from both sides, as only a part drawn alone is, the fused field
    crosses zero once more, some voxels before it; and at edges depths of two surfaces mix.

    Raises:
        ToolkitError: nothing is near enough.
    """
    mesh = surface_mesh(run, part, options)
    search = NearestNeighbors(n_neighbors=1).fit(part.means.numpy())
    distance_m, nearest = (found[:, 0] for found in search.kneighbors(mesh.vertices_m))
    reach_m = 2.0 * (options.voxel_m + part.radii_m.numpy()[nearest])
    kept = (distance_m <= reach_m)[mesh.triangles].all(axis=1)
    if not kept.any():
        raise ToolkitError("what was asked for is too thin or too small to make a mesh of")
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    return TriangleMesh(
        mesh.vertices_m[used],
        mesh.colours[used],
        triangles.reshape(-1, 3).astype(np.int32),
    )


def _views(run: FinishedRun, gaussians: GaussianCloud, every: int) -> Iterator[DepthView]:
    camera = run.camera
    frames = run.tracked[::every]
    for frame in tqdm(frames, unit="view", file=sys.stderr, disable=not sys.stderr.isatty()):
        drawn = render_surface(
            backend(run.settings.backend),
            gaussians,
            camera,
            se3.inverse(frame.T_map_camera),
            RenderOptions(_MIN_SILHOUETTE),
        )
        rgb = np.clip(drawn.output.colour.numpy(), 0.0, 1.0)
        yield DepthView(camera, frame.T_map_camera, rgb, drawn.depth_m.numpy())
