"""Camera frusta and their overlap.

Overlap is estimated from sample points of observed surfaces.
Occlusion is ignored: a wall between two cameras does not change their overlap.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d

Array = NDArray[np.float64]

# Near plane: the smaller of these, in metres, and as a share of the far plane.
NEAR_M, _NEAR = 0.1, 0.1
# Far plane where no depth is known, in metres.
DEFAULT_FAR_M = 4.0
# The farthest few percent of a depth image are noise or surfaces behind windows.
_FAR_PERCENT = 95.0
# Planes of the solid that stands for a frustum.
_SOLID_NEAR_M, _SOLID_FAR_M = 0.05, 100.0
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


def near_plane_m(far_m: float | Array) -> Array:
    """Near plane [...] of views with a far plane [...]."""
    return np.minimum(NEAR_M, _NEAR * np.asarray(far_m))


@dataclass(frozen=True)
class Frustum:
    """A camera's frustum between a near and a far plane.

    Attributes:
        camera: intrinsics; the image extends half a pixel beyond the centres of the outer pixels.
        T_world_camera: [4, 4] float64 pose.
        near_m, far_m: z-depths of the near and far planes, 0 < near < far. A near plane of
            NEAR_M is nearer if the far plane is.

    Raises:
        ValueError: 0 < near < far does not hold, or the pose is not rigid.
    """

    camera: Camera
    T_world_camera: Array
    near_m: float = NEAR_M
    far_m: float = DEFAULT_FAR_M

    def __post_init__(self) -> None:
        if self.near_m == NEAR_M:
            object.__setattr__(self, "near_m", float(near_plane_m(self.far_m)))
        if not 0.0 < self.near_m < self.far_m < np.inf:
            raise ValueError(f"0 < near < far must hold, got {self.near_m} and {self.far_m}")
        if not se3.is_rigid(self.T_world_camera):
            raise ValueError("T_world_camera must be a rigid motion [4, 4]")

    def contains(self, points_world_m: NDArray) -> NDArray[np.bool_]:
        """Return a mask [...] of the points [..., 3] inside the frustum."""
        points = se3.transform_points(se3.inverse(self.T_world_camera), points_world_m)
        return in_view(self.camera, points, self.near_m, self.far_m)


def in_view(
    camera: Camera, points_m: NDArray, near_m: float | Array, far_m: float | Array
) -> NDArray[np.bool_]:
    """Return a mask [...] of the points that project into the image.

    Args:
        points_m: [..., 3] in camera coordinates; non-finite points are outside.
        near_m, far_m: minimum and maximum z-depth; both may be arrays that broadcast to
            the leading axes of the points.
    """
    z = points_m[..., 2]
    with np.errstate(invalid="ignore"):
        between = (z >= near_m) & (z <= far_m)
        uv = camera.project(np.where(between[..., None], points_m, [0.0, 0.0, 1.0]))
        inside = (uv >= -0.5).all(axis=-1)
        inside &= (uv[..., 0] <= camera.width - 0.5) & (uv[..., 1] <= camera.height - 0.5)
    return between & inside


def contained_fraction(points_world_m: NDArray, frusta: Sequence[Frustum]) -> float:
    """Return the fraction of the points [P, 3] inside at least one frustum; 0 without points."""
    outside = np.asarray(points_world_m, np.float64).reshape(-1, 3)
    count = len(outside)
    for frustum in frusta:
        outside = outside[~frustum.contains(outside)]
    return 1.0 - len(outside) / count if count else 0.0


def observed_points(camera: Camera, depth_m: NDArray, count: int) -> Array:
    """Unproject a depth image on a regular grid of about `count` pixels.

    Args:
        depth_m: [H, W] z-depth, 0 where missing.
        count: approximate number of points, > 0.

    Returns:
        Points [P, 3] in camera coordinates, NaN where depth is missing. P depends only on the
        image size and `count`.
    """
    stride = max(1, int(np.sqrt(depth_m.size / count)))
    sparse = camera.unproject(depth_m, stride).reshape(-1, 3)
    return np.where(sparse[:, 2:] > 0, sparse, np.nan)


def far_depth_m(depth_m: NDArray) -> float:
    """Return the far plane of a depth image: the 95th percentile of its valid depths, metres.

    Args:
        depth_m: [H, W] or [P] z-depths; 0 or NaN where missing.
    """
    measured = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    return float(np.percentile(measured, _FAR_PERCENT)) if len(measured) else DEFAULT_FAR_M


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
    vertices = np.concatenate([_SOLID_NEAR_M * ray, _SOLID_FAR_M * ray]).astype(np.float32)
    tensor = open3d().core.Tensor.from_numpy
    scene = open3d().t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor(vertices), tensor(_TRIANGLES))
    return scene
