"""Points inside a camera's frustum, tested by Open3D on a closed mesh of the frustum."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry.camera import Camera
from toolkit.geometry.open3d_bridge import open3d

_NEAR_M, _FAR_M = 0.05, 100.0
# A ray that meets an edge of the mesh can count two triangles; the majority of three rays decides.
_RAYS_PER_POINT = 3
# Corners of a frustum: four of the near plane, then four of the far plane, both clockwise.
_TRIANGLES = np.array(
    [
        *[(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)],
        *[(0, 4, 5), (0, 5, 1), (1, 5, 6), (1, 6, 2), (2, 6, 7), (2, 7, 3), (3, 7, 4), (3, 4, 0)],
    ],
    np.uint32,
)


def inside_frustum(camera: Camera, points_camera_m: NDArray) -> NDArray[np.bool_]:
    """Mask [P] of the points [P, 3] in camera coordinates that project into the image.

    The frustum extends from 5 cm to 100 m and is bounded by the centres of the outer pixels.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    if not len(points_camera_m):
        return np.zeros(0, bool)
    points = open3d().core.Tensor.from_numpy(np.ascontiguousarray(points_camera_m, np.float32))
    # With one thread the result does not depend on how many the machine has.
    occupancy = _frustum(camera).compute_occupancy(points, nthreads=1, nsamples=_RAYS_PER_POINT)
    return np.asarray(occupancy.numpy() > 0.5)


@functools.lru_cache(maxsize=8)
def _frustum(camera: Camera) -> Any:
    """The frustum in camera coordinates as a scene for ray casting."""
    corners = [(0, 0), (camera.width - 1, 0), (camera.width - 1, camera.height - 1)]
    u, v = np.array([*corners, (0, camera.height - 1)], float).T
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(4)], axis=1)
    vertices = np.concatenate([_NEAR_M * ray, _FAR_M * ray]).astype(np.float32)
    tensor = open3d().core.Tensor.from_numpy
    scene = open3d().t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor(vertices), tensor(_TRIANGLES))
    return scene
