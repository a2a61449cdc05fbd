"""Viewing volumes bounded by measured depth, and the points inside their union (Open3D).

A plain frustum extends through walls. The volume here ends at the surface that the camera
measured: a point is inside if it projects into the image and no part of that surface lies between
it and the camera, which a `RaycastingScene` tests.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.camera import Camera
from toolkit.geometry.open3d_bridge import open3d

# Vertices along the longer side of the image. With twice as many, a keyframe's overlap changes by
# about 1 %, and a mesh takes four times as long to build.
_VERTICES = 40
# The surface lies this factor beyond the measured depth, so that the volume contains it.
_TOLERANCE = 1.05
# Where depth is missing, the volume is unbounded.
_UNBOUNDED_M = 100.0
_NEAR_M = 0.05


@dataclass(frozen=True)
class ViewingVolume:
    """Space between a camera and the surface that its depth image measured.

    Coordinates are the camera's own, so a volume stays valid when the camera's pose is corrected.

    Attributes:
        camera: intrinsics of the depth image.
        depth_m: [H, W] z-depth, 0 where missing.
    """

    camera: Camera
    depth_m: NDArray[np.float32]

    def in_front(self, points_camera_m: NDArray) -> NDArray[np.bool_]:
        """Mask [P] of the points [P, 3] inside the image that lie in front of the surface.

        Raises:
            DependencyError: Open3D cannot be loaded.
        """
        rays = np.zeros((len(points_camera_m), 6), np.float32)
        rays[:, 3:] = points_camera_m
        # A ray's length is its point's distance, so 1 is the point itself.
        occluded = self._scene.test_occlusions(
            open3d().core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0, nthreads=1
        )
        return ~np.asarray(occluded.numpy(), bool)

    @functools.cached_property
    def _scene(self) -> Any:
        """The measured surface as triangles between a regular grid of pixels."""
        height, width = self.depth_m.shape
        rows, columns = (_grid(size, max(height, width)) for size in (height, width))
        z = self.depth_m[np.ix_(_nearest(rows, height), _nearest(columns, width))]
        z = np.where(z > 0, _TOLERANCE * z, _UNBOUNDED_M)
        vertices = self.camera.unproject_grid(columns, rows, z).reshape(-1, 3)
        tensor = open3d().core.Tensor.from_numpy
        # With one thread the result does not depend on how many the machine has.
        scene = open3d().t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            tensor(vertices.astype(np.float32)), tensor(_triangles(len(rows), len(columns)))
        )
        return scene


def inside_union(
    points_world_m: NDArray[np.float64],
    volumes: Sequence[ViewingVolume],
    T_world_cameras: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Mask [P] of the points [P, 3] that lie in at least one of K viewing volumes.

    Args:
        T_world_cameras: [K, 4, 4] poses of the volumes' cameras.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    inside = np.zeros(len(points_world_m), bool)
    if not volumes or not len(points_world_m):
        return inside
    rotations, positions = T_world_cameras[:, :3, :3], T_world_cameras[:, None, :3, 3]
    # Single precision, as in the ray casting.
    offsets = (points_world_m - positions).astype(np.float32)
    points = np.matmul(offsets, rotations.astype(np.float32))
    in_image = _in_images(points, [volume.camera for volume in volumes])
    # Start with the camera that sees most points; few other cameras are then tested.
    for k in np.argsort(-in_image.sum(axis=1), kind="stable"):
        remaining = np.flatnonzero(in_image[k] & ~inside)
        if len(remaining):
            inside[remaining] = volumes[k].in_front(points[k, remaining])
    return inside


def _in_images(points: NDArray[np.float32], cameras: Sequence[Camera]) -> NDArray[np.bool_]:
    """Which points [K, P, 3], in the coordinates of K cameras, project into the images, [K, P]."""
    values = np.array(
        [(c.fx, c.fy, c.cx, c.cy, c.width - 1, c.height - 1) for c in cameras], np.float32
    )
    fx, fy, cx, cy, right, bottom = values.T[:, :, None]
    z = points[..., 2]
    ahead = z > _NEAR_M
    z = np.where(ahead, z, 1.0)
    u, v = fx * points[..., 0] / z + cx, fy * points[..., 1] / z + cy
    return ahead & (u >= 0) & (u <= right) & (v >= 0) & (v <= bottom)


def _grid(size: int, longer: int) -> NDArray[np.float64]:
    """Pixel coordinates of the vertices along one side of the image, from edge to edge."""
    count = max(2, min(size, round(_VERTICES * size / longer)))
    return np.linspace(-0.5, size - 0.5, count)


def _nearest(positions: NDArray[np.float64], size: int) -> NDArray[np.intp]:
    """The pixels that contain these coordinates."""
    return np.floor(positions + 0.5).astype(np.intp).clip(0, size - 1)


@functools.lru_cache(maxsize=8)
def _triangles(rows: int, columns: int) -> NDArray[np.uint32]:
    """Triangles [T, 3] of a grid of vertices."""
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    return np.concatenate([np.stack(corners, axis=1) for corners in ((a, c, b), (b, c, d))])
