"""Where the camera may be, from Open3D's odometry of the frame against the drawn map.

Point to plane: of its three methods it reached the place from the farthest (steps of 5 to 20
degrees on real recordings), and it knows neither texture nor exposure, so it fails on other
frames than the tracker's own photometric levels do. It is a start, and no more precise.
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

# Its three levels from coarse to fine. Open3D's defaults stop far from the optimum.
_ITERATIONS = (30, 20, 10)
# Depth beyond it is ignored; no sensor that we read reaches it.
_FARTHEST_M = 100.0


def frame_to_model(
    view: ModelLevel, frame: FrameLevel, T_view_frame: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Pose of a frame against a drawn view, by depth alone.

    Reproducible: the bridge holds Open3D to one thread.

    Args:
        view, frame: one pyramid level of each, of the same camera.
        T_view_frame: [4, 4] where to begin.

    Returns:
        T_view_frame [4, 4], or None where the equations cannot be solved.

    Raises:
        DependencyError: Open3D cannot be loaded.
        ToolkitError: the cameras differ; Open3D's odometry takes one.
    """
    if view.camera != frame.camera:
        raise ToolkitError(
            "Open3D's odometry needs one camera for both images: draw the view with the frame's "
            f"camera ({_described(frame.camera)}), not with {_described(view.camera)}"
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
            _FARTHEST_M,
            [odometry.OdometryConvergenceCriteria(count) for count in _ITERATIONS],
            odometry.Method.PointToPlane,
        )
    except RuntimeError:  # singular equations: too little in common, or one bare wall
        return None
    T_found = np.asarray(result.transformation.numpy(), dtype=np.float64)
    return se3.orthonormalise(T_found) if np.isfinite(T_found).all() else None


def _depth_image(o3d: ModuleType, depth_m: NDArray[np.float32]) -> Any:
    """An RGB-D image of Open3D's; point to plane never reads its colour."""
    image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(np.ascontiguousarray(depth_m)))
    return o3d.t.geometry.RGBDImage(image, image)


def _described(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}, fx {camera.fx:g}, fy {camera.fy:g}"


def _matrix(o3d: ModuleType, camera: Camera) -> Any:
    return o3d.core.Tensor.from_numpy(camera.matrix)
