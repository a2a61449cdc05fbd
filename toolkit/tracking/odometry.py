"""Initial pose of a frame from Open3D's RGB-D odometry against the rendered map.

It uses the point-to-plane method, which had the largest basin of convergence of the three (steps
of 5 to 20 degrees on real recordings). It depends neither on texture nor on exposure, and
therefore fails on other frames than the tracker's photometric alignment. The result is only
accurate enough for an initial pose.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import FrameLevel, ModelLevel
from toolkit.errors import ToolkitError
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.geometry.open3d_bridge import open3d

# Iterations per pyramid level from coarse to fine. Open3D's defaults stop far from the optimum.
_ITERATIONS = (30, 20, 10)
# Larger depth is ignored; it is beyond the range of all supported sensors.
_MAX_DEPTH_M = 100.0


def frame_to_model(
    view: ModelLevel, frame: FrameLevel, T_view_frame: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Estimate the pose of a frame relative to a rendered view, from depth only.

    Reproducible, because `open3d_bridge` limits Open3D to one thread.

    Args:
        view, frame: one pyramid level of each, with the same camera.
        T_view_frame: [4, 4] initial pose.

    Returns:
        T_view_frame [4, 4], or None if the equations cannot be solved.

    Raises:
        DependencyError: Open3D cannot be loaded.
        ToolkitError: the cameras differ; Open3D's odometry supports a single camera.
    """
    if view.camera != frame.camera:
        raise ToolkitError(
            "Open3D's odometry needs the same camera for both images: render the view with the "
            f"frame's camera ({_described(frame.camera)}), not with {_described(view.camera)}"
        )
    o3d = open3d()
    odometry = o3d.t.pipelines.odometry
    try:
        result = odometry.rgbd_odometry_multi_scale(
            _depth_image(o3d, frame.depth_m.cpu().numpy()),
            _depth_image(o3d, view.texture[..., 3].cpu().numpy()),
            _matrix(o3d, frame.camera),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(T_view_frame, dtype=np.float64)),
            1.0,
            _MAX_DEPTH_M,
            [odometry.OdometryConvergenceCriteria(count) for count in _ITERATIONS],
            odometry.Method.PointToPlane,
        )
    except RuntimeError:  # singular equations: too little overlap, or a single plane
        return None
    T = np.asarray(result.transformation.numpy(), dtype=np.float64)
    return se3.orthonormalise(T) if np.isfinite(T).all() else None


def _depth_image(o3d: ModuleType, depth_m: NDArray[np.float32]) -> Any:
    """Open3D RGB-D image; the point-to-plane method does not read its colour."""
    image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(np.ascontiguousarray(depth_m)))
    return o3d.t.geometry.RGBDImage(image, image)


def _described(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}, fx {camera.fx:g}, fy {camera.fy:g}"


def _matrix(o3d: ModuleType, camera: Camera) -> Any:
    return o3d.core.Tensor.from_numpy(camera.matrix)
