"""Triangle meshes fused from depth images (TSDF) and point clouds, using Open3D."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.atomic import replacing
from toolkit.io.process_streams import silenced
from toolkit.io.suffixes import MESH_SUFFIXES, POINT_SUFFIXES

PathLike = str | os.PathLike[str]

# Voxels along an edge of the blocks that Open3D allocates near surfaces.
_BLOCK_EDGE = 16
# Initial capacity of the voxel grid in blocks; it grows automatically.
_FIRST_BLOCKS = 2000
# Pixel stride, in rows and columns, with which Open3D samples depth to allocate blocks.
_STRIDE = 4
# Sizes in files: three doubles and a colour; a count and three indices.
_VERTEX_BYTES, _TRIANGLE_BYTES = 27, 13


@dataclass(frozen=True)
class PosedDepth:
    """Depth and colour image of one pose, rendered or measured.

    Attributes:
        camera: intrinsics of both images.
        T_world_camera: [4, 4] float64, camera to world, metres.
        rgb: [H, W, 3] float32, RGB in [0, 1].
        depth_m: [H, W] float32 z-depth in metres, 0 where missing. Rendered depth must be
            divided by the silhouette and set to 0 where the silhouette is low.
    """

    camera: Camera
    T_world_camera: NDArray[np.float64]
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]


@dataclass(frozen=True)
class TriangleMesh:
    """A coloured surface.

    Attributes:
        vertices_m: [V, 3] float32, world, metres.
        colours: [V, 3] float32, RGB in [0, 1].
        triangles: [T, 3] int32, vertex indices.
    """

    vertices_m: NDArray[np.float32]
    colours: NDArray[np.float32]
    triangles: NDArray[np.int32]

    def __str__(self) -> str:
        return f"{len(self.vertices_m)} vertices, {len(self.triangles)} triangles"


def fuse_views(
    views: Iterable[PosedDepth], voxel_m: float, max_depth_m: float = 10.0
) -> TriangleMesh:
    """Fuse depth images in a truncated signed distance field and extract its surface.

    Args:
        views: iterated once.
        voxel_m: edge of a voxel in metres, > 0; memory grows with its inverse square.
        max_depth_m: maximum depth that is integrated, metres, > 0.

    Raises:
        ToolkitError: no view has depth within `max_depth_m`.
    """
    if voxel_m <= 0 or max_depth_m <= 0:
        raise ValueError(f"voxel_m and max_depth_m must be > 0, got {voxel_m} and {max_depth_m}")
    grid = _empty_grid(voxel_m)
    fused = False
    for view in views:
        if _touches_surface(view.depth_m, max_depth_m):
            _integrate(grid, view, max_depth_m)
            fused = True
    if not fused:
        raise ToolkitError(
            f"no view has depth below {max_depth_m:g} m on more than a few pixels, so there is "
            "no surface to extract; increase the maximum depth"
        )
    # The default threshold removes surfaces observed by fewer than three views.
    mesh = grid.extract_triangle_mesh(weight_threshold=0)
    return TriangleMesh(
        mesh.vertex.positions.numpy().astype(np.float32),
        np.clip(mesh.vertex.colors.numpy(), 0.0, 1.0).astype(np.float32),
        mesh.triangle.indices.numpy().astype(np.int32),
    )


def write_mesh(
    path: PathLike, mesh: TriangleMesh, origin_m: NDArray[np.float64] | None = None
) -> None:
    """Write a mesh as .ply atomically, with vertices in double precision.

    Args:
        path: the file.
        mesh: the mesh.
        origin_m: [3] is added to the vertices; 0 if absent.

    Raises:
        FormatError: the suffix is not .ply.
        RunFolderError: the file cannot be written.
    """
    path = _with_suffix(path, MESH_SUFFIXES)
    o3d = open3d()
    vertices_m = mesh.vertices_m + (np.zeros(3) if origin_m is None else origin_m)
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices_m),
        o3d.utility.Vector3iVector(mesh.triangles),
    )
    surface.vertex_colors = o3d.utility.Vector3dVector(mesh.colours.astype(np.float64))
    # Open3D crashes on a full disk.
    size = _VERTEX_BYTES * len(vertices_m) + _TRIANGLE_BYTES * len(mesh.triangles)
    with replacing(path, size) as temporary, silenced():
        _must(o3d.io.write_triangle_mesh(str(temporary), surface))


def write_points(path: PathLike, points_m: NDArray, colours: NDArray) -> None:
    """Write a coloured point cloud as .ply or .pcd atomically.

    Args:
        path: the file.
        points_m: [N, 3], metres.
        colours: [N, 3], RGB in [0, 1]; clamped.

    Raises:
        FormatError: the suffix is neither .ply nor .pcd.
        RunFolderError: the file cannot be written.
    """
    path = _with_suffix(path, POINT_SUFFIXES)
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m.astype(np.float64)))
    cloud.colors = o3d.utility.Vector3dVector(np.clip(colours, 0.0, 1.0).astype(np.float64))
    with replacing(path, _VERTEX_BYTES * len(points_m)) as temporary, silenced():
        _must(o3d.io.write_point_cloud(str(temporary), cloud))


def _empty_grid(voxel_m: float) -> Any:
    o3d = open3d()
    float32 = o3d.core.float32
    return o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(float32, float32, float32),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel_m,
        block_resolution=_BLOCK_EDGE,
        block_count=_FIRST_BLOCKS,
    )


def _touches_surface(depth_m: NDArray[np.float32], max_depth_m: float) -> bool:
    """Check whether Open3D finds depth in range.

    Open3D samples one pixel in 16 to allocate blocks, and fails if none of them is in range.
    """
    height, width = (side - side % _STRIDE for side in depth_m.shape)
    sampled = depth_m[:height:_STRIDE, :width:_STRIDE]
    return bool(((sampled > 0) & (sampled < max_depth_m)).any())


def _integrate(grid: Any, view: PosedDepth, max_depth_m: float) -> None:
    o3d = open3d()
    # Open3D truncates projections to integers, which assumes pixel centres at +0.5; ours are at
    # integers. Without the shift, slanted surfaces are displaced.
    K = view.camera.matrix
    K[:2, 2] += 0.5
    intrinsic = o3d.core.Tensor(K)
    T_camera_world = o3d.core.Tensor(se3.inverse(view.T_world_camera))
    # Both as float32, because Open3D does not accept mixed types.
    depth = o3d.t.geometry.Image(_float_tensor(view.depth_m))
    colour = o3d.t.geometry.Image(_float_tensor(view.rgb))
    blocks = grid.compute_unique_block_coordinates(
        depth, intrinsic, T_camera_world, depth_scale=1.0, depth_max=max_depth_m
    )
    grid.integrate(
        blocks,
        depth,
        colour,
        intrinsic,
        intrinsic,
        T_camera_world,
        depth_scale=1.0,
        depth_max=max_depth_m,
    )


def _float_tensor(image: NDArray) -> Any:
    return open3d().core.Tensor(np.ascontiguousarray(image, dtype=np.float32))


def _with_suffix(path: PathLike, suffixes: tuple[str, ...]) -> Path:
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise FormatError(f"{path}: the name must end in {' or '.join(suffixes)}")
    return path


def _must(written: bool) -> None:
    # Open3D reports only success or failure.
    if not written:
        raise OSError("Open3D could not write the file")
