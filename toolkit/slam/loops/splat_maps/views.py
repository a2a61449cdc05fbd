"""Virtual views of a map: renderings that serve as keyframes where a map has none."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, render_surface
from toolkit.splatting.rendering.backend import Backend

# Wider images are rendered at half the size, a quarter and so on.
_MAX_WIDTH = 400
# Minimum silhouette (0-1) of pixels with depth, and minimum fraction of such pixels in a view.
_MIN_SILHOUETTE, _MIN_OPAQUE = 0.8, 0.3


def view_camera(camera: Camera) -> Camera:
    """The camera of the views for frames of a camera."""
    while camera.width > _MAX_WIDTH:
        camera = camera.halved()
    return camera


def virtual_keyframe(
    backend: Backend,
    cloud: GaussianCloud,
    camera: Camera,
    T_map_camera: NDArray[np.float64],
    index: int,
) -> Keyframe | None:
    """Render a map as a keyframe; None if it shows too little.

    Its depth counts as inferred, not as measured.
    """
    with torch.no_grad():
        view = render_surface(
            backend, cloud, camera, se3.inverse(T_map_camera), RenderOptions(_MIN_SILHOUETTE)
        )
    depth_m = view.depth_m.cpu().numpy()
    if (depth_m > 0).mean() < _MIN_OPAQUE:
        return None
    rgb = view.output.colour.clamp(0.0, 1.0).cpu().numpy()
    inferred = np.ones(depth_m.shape, np.bool_)
    frame = Frame(
        index,
        float(index),
        np.ascontiguousarray(rgb),
        np.ascontiguousarray(depth_m),
        camera,
        inferred=inferred,
    )
    return Keyframe.from_frame(frame, T_map_camera)
