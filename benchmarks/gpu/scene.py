"""What the GPU benchmark draws and tracks: a textured, wavy surface of pixel-sized Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.native.constants import MIN_ALPHA
from toolkit.splatting.gaussians.cloud import PIXEL_FILTER, GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering import RenderOptions, render_surface
from toolkit.splatting.rendering.backend import Backend

_STEP_M, _TURN_RAD = 0.01, 0.004  # a frame: a person's pace at 30 Hz
_PATCH_M = 0.2  # side of a patch of one class


def camera_of(width: int, height: int) -> Camera:
    """Replica's field of view: 600 pixels at a width of 1200."""
    focal = width / 2.0
    return Camera(focal, focal, (width - 1) / 2.0, (height - 1) / 2.0, width, height)


def surface_cloud(
    camera: Camera, count: int, features: int, margin: float = 1.0, seed: int = 0
) -> GaussianCloud:
    """Gaussians on a surface about 2 m away, of 0.6 to 1 pixel and opacity 0.5 to 0.95.

    Args:
        features: S further channels.
        margin: side of the part of the surface they cover, in image sides.
    """
    rng = np.random.default_rng(seed)
    u = rng.uniform(0.5 - margin / 2, 0.5 + margin / 2, count)
    v = rng.uniform(0.5 - margin / 2, 0.5 + margin / 2, count)
    depth = 2.0 + 0.4 * np.sin(9.0 * u) + 0.3 * np.cos(7.0 * v) + 0.005 * rng.standard_normal(count)
    x = (u * camera.width - camera.cx) / camera.fx * depth
    y = (v * camera.height - camera.cy) / camera.fy * depth
    shades = [
        np.sin(a * u + b * v) * np.cos(c * u - a * v)
        for a, b, c in ((31, 17, 5), (13, 41, 23), (7, 11, 53))
    ]
    colours = 0.5 + 0.35 * np.stack(shades, axis=1) + 0.05 * rng.standard_normal((count, 3))
    sigma_m = rng.uniform(0.6, 1.0, count) * depth / camera.focal
    return GaussianCloud.from_values(
        _tensor(np.stack([x, y, depth], axis=1)),
        _tensor(sigma_m),
        _tensor(rng.uniform(0.5, 0.95, count)),
        _tensor(colours.clip(0.02, 0.98)),
        torch.randn(count, features, generator=torch.Generator().manual_seed(seed)),
    )


def with_ellipsoids(cloud: GaussianCloud, seed: int = 0) -> GaussianCloud:
    """The same Gaussians as turned discs, filtered, with colours that depend on the view."""
    generator = torch.Generator().manual_seed(seed)
    count = len(cloud)
    shapes = Ellipsoids(
        cloud.log_radii[:, None] + torch.tensor([0.5, 0.0, -1.5]),
        torch.randn(count, 4, generator=generator),
        0.05 * torch.randn(count, HARMONIC_COUNTS[1], 3, generator=generator),
    )
    return replace(cloud, ellipsoids=shapes, low_pass=PIXEL_FILTER)


def _tensor(array: NDArray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def touched_pixels(cloud: GaussianCloud, camera: Camera) -> float:
    """Pixels within the support of each Gaussian, summed: the fewest alphas to compute."""
    sigma = camera.focal * cloud.radii_m / cloud.means[:, 2]
    support = 2.0 * sigma**2 * (cloud.opacities / MIN_ALPHA).clamp(min=1.0).log()
    return float((torch.pi * support).double().sum())


def walk(backend: Backend, camera: Camera, frames: int, device: str, classes: int) -> list[Frame]:
    """Frames of a short walk along the surface, drawn from Gaussians a pixel and more.

    Args:
        classes: that the surface is divided among, in patches.
    """
    pixels = camera.width * camera.height
    cloud = surface_cloud(camera, 4 * pixels, 0, margin=1.5).to(device)
    out = []
    for index in range(frames):
        view = render_surface(
            backend, cloud, camera, se3.inverse(pose_of(index)), RenderOptions(min_silhouette=0.9)
        )
        rgb = view.output.colour.clamp(0.0, 1.0).contiguous().cpu().numpy()
        depth_m = view.depth_m.cpu().numpy()
        labels = _patches(camera, depth_m, pose_of(index), classes)
        out.append(Frame(index, index / 30.0, rgb, depth_m, labels=labels, camera=camera))
    return out


def _patches(
    camera: Camera, depth_m: NDArray[np.float32], T_map_camera: NDArray[np.float64], classes: int
) -> NDArray[np.int32]:
    """Class ids [H, W] of a view, the same of a place from everywhere; 0 without depth."""
    points = se3.transform_points(T_map_camera, camera.unproject(depth_m).reshape(-1, 3))
    column, row = np.floor(points[:, :2] / _PATCH_M).astype(np.int64).T
    ids = 1 + (column + 7 * row) % classes
    return np.where(depth_m > 0, ids.reshape(depth_m.shape), 0).astype(np.int32)


def trajectory(frames: int) -> Trajectory:
    """Where the walk's cameras are."""
    return Trajectory(np.arange(frames) / 30.0, np.array([pose_of(i) for i in range(frames)]))


def pose_of(index: int) -> NDArray[np.float64]:
    """T_map_camera [4, 4] of a frame; the first camera is the map's frame."""
    tangent = np.array([_STEP_M, -0.4 * _STEP_M, 0.5 * _STEP_M, 0.3 * _TURN_RAD, -_TURN_RAD, 0.0])
    return se3.exp(tangent * index)
