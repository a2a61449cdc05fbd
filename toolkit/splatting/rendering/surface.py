"""Surface depth of a rendered view, without the bias of compositing.

Front-to-back compositing gives the nearer of two overlapping Gaussians more weight. On a slanted
surface, the weighted mean depth is therefore that of a point up to half a pixel off the ray: a
bias of about 3 mm at 2 m for images of 320x240, always towards the camera and dependent on the
viewpoint. The weighted mean of the Gaussians' centres lies on the surface, so the depth of a
pixel is computed as the intersection of its ray with the plane through that mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native import address, kernels_for
from toolkit.base.native.constants import (
    BASE_CHANNELS,
    MAX_DEPTH_STEP,
    MAX_SURFACE_CORRECTION,
    MIN_NORMAL,
    SILHOUETTE,
)
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.backend import Backend, ForwardPass
from toolkit.splatting.rendering.output import RenderOutput


@dataclass(frozen=True)
class RenderOptions:
    """Rendering options of a surface view.

    Attributes:
        min_silhouette: minimum silhouette (0-1) of pixels with a surface.
        features: whether to render the Gaussians' feature channels.
    """

    min_silhouette: float = 0.5
    features: bool = False


@dataclass(frozen=True)
class SurfaceView:
    """A rendered view and its surface depth.

    Attributes:
        forward_pass: the forward pass, whose last three channels are the centres.
        depth_m: [H, W] depth of the surface along each ray, 0 where the silhouette is too small.
        camera, T_camera_map: intrinsics and pose of the view.
        centred_colours: of the Gaussians, as in `GaussianCloud`.
    """

    forward_pass: ForwardPass
    depth_m: Tensor
    camera: Camera
    T_camera_map: NDArray[np.float64]
    centred_colours: bool = False

    @property
    def images(self) -> Tensor:
        """Colour, depth sum and silhouette [5, H, W]."""
        return self.forward_pass.images[:BASE_CHANNELS]

    @property
    def features(self) -> Tensor:
        """Feature channels [S, H, W], weighted sums like the colour."""
        return self.forward_pass.images[BASE_CHANNELS:-3]

    @property
    def output(self) -> RenderOutput:
        """The view as returned by `render`."""
        return RenderOutput(self.images)


def render_surface(
    backend: Backend,
    gaussians: GaussianCloud,
    camera: Camera,
    T_camera_map: NDArray[np.float64],
    options: RenderOptions | None = None,
) -> SurfaceView:
    """Render Gaussians with their centres and compute the surface depth.

    Args:
        T_camera_map: [4, 4], map to camera.
    """
    options = options or RenderOptions()
    channels = gaussians.features if options.features else None
    forward_pass = backend.forward(gaussians, camera, T_camera_map, channels, None, centres=True)
    if gaussians.ellipsoids is None:
        images = forward_pass.images
        depth_m = surface_depth(images, camera, T_camera_map, options.min_silhouette)
    else:
        depth_m = _mean_depth(forward_pass.images, options.min_silhouette)
    return SurfaceView(forward_pass, depth_m, camera, T_camera_map, gaussians.centred_colours)


def _mean_depth(images: Tensor, min_silhouette: float) -> Tensor:
    """The surface depth [H, W] of ellipsoids, whose depth follows their planes."""
    return RenderOutput(images).depth_m * (images[SILHOUETTE] >= min_silhouette)


def surface_depth(
    images: Tensor, camera: Camera, T_camera_map: NDArray[np.float64], min_silhouette: float
) -> Tensor:
    """Compute the surface depth [H, W] of images [..., H, W] that end with the centres."""
    module = kernels_for(images)
    if module is None:
        return _surface_depth_torch(images, camera, T_camera_map, min_silhouette)
    depth_m = images.new_empty(camera.height, camera.width)
    module.surface_depth(
        *kernel_geometry(camera, T_camera_map),
        address(images),
        address(images[-3:]),
        min_silhouette,
        address(depth_m),
    )
    return depth_m


def kernel_geometry(
    camera: Camera, T_camera_map: NDArray[np.float64]
) -> tuple[tuple[float, ...], tuple[int, int], list[float]]:
    """Return intrinsics, image size and pose as arguments for the native kernels."""
    pose = np.asarray(T_camera_map[:3]).reshape(-1).tolist()
    return (camera.fx, camera.fy, camera.cx, camera.cy), camera.size, pose


def same_surface(before_m: Tensor, depth_m: Tensor, after_m: Tensor) -> Tensor:
    """Check whether pixels and their neighbours on both sides belong to one surface.

    They do if their depths are similar, or if they lie on a plane of any slope: inverse depth is
    linear in the image coordinates of a plane.

    Args:
        before_m, depth_m, after_m: depths in metres, of the same shape.
    """
    bend = (depth_m / before_m + depth_m / after_m - 2.0).abs()
    return ((after_m - before_m).abs() <= MAX_DEPTH_STEP * depth_m) | (bend <= 0.5 * MAX_DEPTH_STEP)


def _surface_depth_torch(
    images: Tensor, camera: Camera, T_camera_map: NDArray[np.float64], min_silhouette: float
) -> Tensor:
    """Compute surface depth in torch: reference and fallback of the native kernel."""
    T = torch.as_tensor(T_camera_map).to(images)
    solid = images[SILHOUETTE] >= min_silhouette
    mean = images[-3:] / torch.where(solid, images[SILHOUETTE], torch.ones_like(images[SILHOUETTE]))
    points = torch.einsum("ij,jyx->yxi", T[:3, :3], mean) + T[:3, 3]
    points = torch.where(solid[..., None], points, torch.zeros_like(points))
    depth = points[..., 2].clone()
    if min(depth.shape) < 3:
        return depth
    centre = points[1:-1, 1:-1]
    left, right = points[1:-1, :-2], points[1:-1, 2:]
    above, below = points[:-2, 1:-1], points[2:, 1:-1]
    around = torch.stack([p[..., 2] for p in (left, right, above, below)])
    smooth = (centre[..., 2] > 0) & (around.amin(0) > 0)
    smooth &= same_surface(left[..., 2], centre[..., 2], right[..., 2])
    smooth &= same_surface(above[..., 2], centre[..., 2], below[..., 2])
    normal = torch.linalg.cross(right - left, below - above)
    # The neighbours are two pixels apart in both directions.
    footprint = 4.0 * centre[..., 2] ** 2 / (camera.fx * camera.fy)
    smooth &= normal.norm(dim=-1) >= MIN_NORMAL * footprint
    # Compute the rays on the device of the images: copying them to a GPU would take longer than
    # rendering the map.
    y, x = (torch.arange(1, n - 1, device=images.device).to(images) for n in depth.shape)
    ray_x, ray_y = (x - camera.cx) / camera.fx, ((y - camera.cy) / camera.fy)[:, None]
    along = normal[..., 0] * ray_x + normal[..., 1] * ray_y + normal[..., 2]
    met = (normal * centre).sum(-1) / along
    smooth &= (met - centre[..., 2]).abs() < MAX_SURFACE_CORRECTION * centre[..., 2]
    depth[1:-1, 1:-1] = torch.where(smooth, met, centre[..., 2])
    return depth
