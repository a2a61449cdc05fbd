"""Scenes, an independent implementation and comparisons for the tests of the renderers.

The discontinuity band. An alpha under 1/255 is dropped, so where an alpha lies within
rounding of that cut two correct renderers may disagree on one Gaussian at that pixel: by
at most 1/255 of the largest value in the colour of the Gaussian, and as much again in all
that it lets through. `BAND` is far wider than the rounding of any backend; pixels in it are
compared with `band_tolerance`, and losses give them no weight. The cap of alpha at 0.999
bends the gradient in the same way and is treated alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.base.native import load_variant
from toolkit.base.native.constants import MAX_ALPHA, MIN_ALPHA, NEAR_M
from toolkit.splatting.gaussians.cloud import GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids, harmonic_basis
from toolkit.splatting.rendering import GaussianGradients
from toolkit.splatting.rendering.backend import Backend, ForwardPass
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.reference import ReferenceBackend

BAND = 1e-5
GROUPS = ("means", "log_radii", "opacity_logits", "colours", "features", "T_camera_map")
SHAPE_GROUPS = ("log_scales", "rotations", "harmonics")


@dataclass(frozen=True)
class Scene:
    """Gaussians and a camera; their features are the rendered channels."""

    cloud: GaussianCloud
    camera: Camera
    T_camera_map: NDArray[np.float64]

    def draw(self, backend: Backend, region: Tensor | None = None) -> Tensor:
        """Images [5 + S, H, W]."""
        return self.forward(backend, region).images

    def forward(self, backend: Backend, region: Tensor | None = None) -> ForwardPass:
        return backend.forward(
            self.cloud, self.camera, self.T_camera_map, self.cloud.features, region
        )

    def loss_weights(self, seed: int = 0) -> Tensor:
        """A random dL/d(images), zero at discontinuities of the rendering."""
        shape = (5 + self.cloud.features.shape[1], self.camera.height, self.camera.width)
        weights = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
        return weights * ~torch.from_numpy(discontinuous_pixels(self))

    def with_cloud(self, **changes: Any) -> Scene:
        return Scene(replace(self.cloud, **changes), self.camera, self.T_camera_map)


def native_backend(instruction_set: str) -> NativeRenderer:
    """The native backend with a given variant of the kernels."""
    backend = NativeRenderer()
    module = load_variant(instruction_set)
    assert module is not None
    backend._module = module
    return backend


def skewed_camera(width: int, height: int) -> Camera:
    """A camera with different focal lengths and an off-centre principal point."""
    return Camera(0.9 * width + 7, 1.1 * width + 5, 0.45 * width, 0.6 * height, width, height)


def scene_at_pixels(
    pixels: list[tuple[float, float]],
    camera: Camera,
    depth_m: float | list[float] = 1.0,
    sigma_px: float = 1.5,
    opacity: float = 0.6,
    channels: int = 0,
) -> Scene:
    """Gaussians that project to the given pixels (x, y) from the map's origin."""
    count = len(pixels)
    xy = torch.tensor(pixels, dtype=torch.float32).reshape(count, 2)
    z = torch.as_tensor(depth_m, dtype=torch.float32).expand(count)
    x = (xy[:, 0] - camera.cx) / camera.fx * z
    y = (xy[:, 1] - camera.cy) / camera.fy * z
    generator = torch.Generator().manual_seed(count)
    cloud = GaussianCloud.from_values(
        torch.stack([x, y, z], dim=1),
        sigma_px * z / camera.focal,
        torch.full((count,), opacity),
        torch.rand(count, 3, generator=generator),
        torch.randn(count, channels, generator=generator),
    )
    return Scene(cloud, camera, np.eye(4))


def random_scene(
    seed: int, count: int = 60, channels: int = 3, size: tuple[int, int] = (45, 37)
) -> Scene:
    """Gaussians of all sizes and opacities in and around the image of a tilted camera.

    Few enough to overlap without reaching the early termination.
    """
    rng = np.random.default_rng(seed)
    camera = skewed_camera(*size)
    T_camera_map = se3.exp(rng.normal(scale=0.3, size=6))
    z = rng.uniform(0.3, 4.0, count)
    u = rng.uniform(-4, size[0] + 3, count)
    v = rng.uniform(-4, size[1] + 3, count)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)
    cloud = GaussianCloud.from_values(
        _tensor(se3.transform_points(se3.inverse(T_camera_map), points)),
        _tensor(np.exp(rng.uniform(np.log(0.3), np.log(5.0), count)) * z / camera.focal),
        _tensor(rng.uniform(0.002, 0.9, count)),
        _tensor(rng.uniform(0, 1, (count, 3))),
        _tensor(rng.normal(size=(count, channels))),
    )
    return Scene(cloud, camera, T_camera_map)


def ellipsoid_scene(
    seed: int,
    low_pass: LowPass,
    degree: int = 3,
    count: int = 60,
    channels: int = 3,
    size: tuple[int, int] = (45, 37),
) -> Scene:
    """Turned ellipsoids with axes of ratios up to 10 and view-dependent colours."""
    scene = random_scene(seed, count, channels, size)
    rng = np.random.default_rng(seed + 1)
    stretch = rng.uniform(-1.15, 1.15, (count, 3))
    shapes = Ellipsoids(
        scene.cloud.log_radii[:, None] + _tensor(stretch),
        _tensor(rng.normal(size=(count, 4))),
        _tensor(rng.normal(scale=0.2, size=(count, HARMONIC_COUNTS[degree], 3))),
    )
    return scene.with_cloud(ellipsoids=shapes, low_pass=low_pass)


def _tensor(array: NDArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))


def exact(scene: Scene) -> Scene:
    """Convert float32 parameters to float64."""
    return Scene(scene.cloud.mapped(torch.Tensor.double), scene.camera, scene.T_camera_map)


def reference_images(scene: Scene, region: Tensor | None = None) -> Tensor:
    return exact(scene).draw(ReferenceBackend(), region)


def raw_alphas(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Alphas [M, H, W] without thresholds, and values [M, 5 + S], front to back."""
    cloud, camera = scene.cloud, scene.camera
    points = se3.transform_points(scene.T_camera_map, cloud.means.double().numpy())
    z = points[:, 2]
    order = np.argsort(z, kind="stable")
    order = order[z[order] > NEAR_M]
    u, v = camera.project(points[order]).T
    footprint, gain = _footprints(scene, order, points[order])
    opacity = cloud.opacity_logits.double().sigmoid().numpy()[order] * gain
    y, x = np.mgrid[: camera.height, : camera.width]
    offset = np.stack([x - u[:, None, None], y - v[:, None, None]], axis=-1)
    squared = np.einsum("nyxi,nij,nyxj->nyx", offset, np.linalg.inv(footprint), offset)
    alphas = opacity[:, None, None] * np.exp(-0.5 * squared)
    values = np.concatenate(
        [
            _seen_colours(scene)[order],
            z[order, None],
            np.ones((len(order), 1)),
            cloud.features.double().numpy()[order],
        ],
        axis=1,
    )
    return alphas, values


def _footprints(scene: Scene, order: NDArray, points: NDArray) -> tuple[NDArray, NDArray]:
    """Covariances [M, 2, 2] in the image and factors [M] of the opacity."""
    cloud, camera, R = scene.cloud, scene.camera, scene.T_camera_map[:3, :3]
    if cloud.ellipsoids is None:
        sigma = camera.focal * cloud.log_radii.double().exp().numpy()[order] / points[:, 2]
        bare = sigma[:, None, None] ** 2 * np.eye(2)
    else:
        turned = Rotation.from_quat(cloud.ellipsoids.rotations.double().numpy()[:, [1, 2, 3, 0]])
        axes = turned.as_matrix()[order]
        variances = np.exp(2.0 * cloud.ellipsoids.log_scales.double().numpy()[order])
        covariances = R @ (axes * variances[:, None]) @ axes.transpose(0, 2, 1) @ R.T
        J = _jacobians(camera, points)
        bare = J @ covariances @ J.transpose(0, 2, 1)
    variance, compensated = cloud.low_pass.variance_px2, cloud.low_pass.compensated
    filtered = bare + variance * np.eye(2)
    ratio = np.linalg.det(bare) / np.linalg.det(filtered)
    return filtered, np.sqrt(ratio) if compensated else np.ones(len(points))


def _jacobians(camera: Camera, points: NDArray) -> NDArray:
    """Jacobians [M, 2, 3] of the projection of points [M, 3], evaluated near the image at most."""
    middle = [(camera.width - 1) / 2, (camera.height - 1) / 2]
    middle -= np.array([camera.cx, camera.cy])
    reach = 1.3 * np.array([camera.width, camera.height]) / 2
    focal = np.array([camera.fx, camera.fy])
    slopes = points[:, :2] / points[:, 2:]
    slopes = np.clip(slopes, (middle - reach) / focal, (middle + reach) / focal)
    J = np.zeros((len(points), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = focal[:, None] / points[:, 2]
    J[:, :, 2] = -focal * slopes / points[:, 2:]
    return J


def _inclined_depths(scene: Scene) -> NDArray:
    """Depth [M, H, W] of each Gaussian at a pixel, relative to that of its centre: a regression.

    Estimated from the Gaussian's principal points, which have its mean and covariance.
    """
    cloud, camera, T = scene.cloud, scene.camera, scene.T_camera_map
    points = se3.transform_points(T, cloud.means.double().numpy())
    order = np.argsort(points[:, 2], kind="stable")
    order = order[points[order, 2] > NEAR_M]
    offsets = np.zeros((len(order), camera.height, camera.width))
    if cloud.ellipsoids is None:
        return offsets
    footprint, _ = _footprints(scene, order, points[order])
    turned = Rotation.from_quat(cloud.ellipsoids.rotations.double().numpy()[:, [1, 2, 3, 0]])
    scales = np.exp(cloud.ellipsoids.log_scales.double().numpy()[order])
    axes = T[:3, :3] @ (turned.as_matrix()[order] * scales[:, None])
    jacobians = _jacobians(camera, points[order])
    steps = jacobians @ axes
    slopes = np.linalg.solve(footprint, np.einsum("nik,nk->ni", steps, axes[:, 2])[:, :, None])
    u, v = camera.project(points[order]).T
    y, x = np.mgrid[: camera.height, : camera.width]
    return slopes[:, 0, :, None] * (x - u[:, None, None]) + slopes[:, 1, :, None] * (
        y - v[:, None, None]
    )


def _seen_colours(scene: Scene) -> NDArray:
    """Colours [N, 3] from the camera."""
    cloud = scene.cloud
    if cloud.ellipsoids is None:
        return cloud.colours.double().numpy()
    centre = se3.inverse(scene.T_camera_map)[:3, 3]
    rays = cloud.means.double().numpy() - centre
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    harmonics = cloud.ellipsoids.harmonics.double().numpy()
    basis = harmonic_basis(torch.from_numpy(rays), harmonics.shape[1]).numpy()
    seen = cloud.colours.double().numpy() + np.einsum("nk,nkc->nc", basis, harmonics)
    return np.maximum(seen, 0.0)


def discontinuous_pixels(scene: Scene) -> NDArray[np.bool_]:
    """Pixels [H, W] where an alpha is within rounding of MIN_ALPHA or MAX_ALPHA."""
    alphas, _ = raw_alphas(scene)
    near = (np.abs(alphas - MIN_ALPHA) < BAND) | (np.abs(alphas - MAX_ALPHA) < BAND)
    return np.asarray(near.any(axis=0))


def largest_value(scene: Scene) -> float:
    """Upper bound of the magnitude of any pixel."""
    _, values = raw_alphas(scene)
    return float(np.abs(values).max(initial=1.0))


def dense_images(scene: Scene) -> NDArray[np.float64]:
    """Render images [5 + S, H, W] by the equations, with every Gaussian at every pixel."""
    alphas, values = raw_alphas(scene)
    passed = np.ones((scene.camera.height, scene.camera.width))
    images = np.zeros((values.shape[1], *passed.shape))
    inclined = _inclined_depths(scene)
    for alpha, value, offset in zip(alphas, values, inclined, strict=True):
        alpha = np.where(alpha >= MIN_ALPHA, np.minimum(alpha, MAX_ALPHA), 0.0)
        images += value[:, None, None] * (alpha * passed)
        images[3] += offset * alpha * passed
        passed = passed * (1.0 - alpha)
    return images


def dense_gradients(gradients: GaussianGradients, count: int) -> dict[str, Tensor]:
    """Expand the gradients to all Gaussians, zero for invisible ones."""
    out = {}
    groups = {name: getattr(gradients, name) for name in GROUPS[:-1]}
    if gradients.ellipsoids is not None:
        del groups["log_radii"]
        groups |= {name: getattr(gradients.ellipsoids, name) for name in SHAPE_GROUPS}
    for name, compact in groups.items():
        if compact is not None:
            out[name] = torch.zeros(count, *compact.shape[1:], dtype=compact.dtype)
            out[name][gradients.ids] = compact
    out["T_camera_map"] = gradients.T_camera_map
    return out


def gradients_of(
    scene: Scene, backend: Backend, weights: Tensor, region: Tensor | None = None
) -> dict[str, Tensor]:
    """Gradients of sum(weights * images) in every group."""
    drawn = scene.forward(backend, region)
    return dense_gradients(drawn.backward(weights.to(drawn.images)), len(scene.cloud))


def assert_same_images(actual: Tensor, scene: Scene, expected: Tensor) -> None:
    """Assert equality in single precision outside the discontinuity band and a bound inside."""
    band = torch.from_numpy(discontinuous_pixels(scene))
    difference = (actual.double() - expected).abs()
    largest = largest_value(scene)
    assert float((difference * ~band).max()) <= 3e-5 * largest
    assert float((difference * band).max()) <= band_tolerance(scene)


def band_tolerance(scene: Scene) -> float:
    """Bound of the change by one Gaussian at MIN_ALPHA, including what it occludes."""
    return 2.0 * MIN_ALPHA * largest_value(scene)


def assert_same_gradients(
    actual: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float = 2e-4
) -> None:
    """Assert equality of every group, relative to its largest entry."""
    assert actual.keys() == expected.keys()
    for name, gradient in actual.items():
        scale = float(expected[name].abs().max()) if expected[name].numel() else 0.0
        error = (gradient.double() - expected[name].double()).abs()
        worst = float(error.max()) if error.numel() else 0.0
        assert worst <= tolerance * scale + 1e-12, f"{name}: {worst:.3g} of {scale:.3g}"


def assert_identical(actual: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Assert exact equality of every group."""
    assert actual.keys() == expected.keys()
    for name, gradient in actual.items():
        assert torch.equal(gradient, expected[name]), name
