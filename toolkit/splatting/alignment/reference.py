"""Alignment in NumPy: the reference of all backends, and the fallback on the CPU."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import (
    LUMA_BLUE,
    LUMA_GREEN,
    LUMA_RED,
    MAX_DEPTH_STEP,
    MIN_NOISE_DEPTH_M,
    NEAR_M,
    SILHOUETTE,
    STUDENT_T_DOF,
)
from toolkit.splatting.alignment.data import (
    FrameLevel,
    Image,
    LevelProblem,
    Linearisation,
    ModelLevel,
)
from toolkit.splatting.alignment.gauss_newton import GaussNewton

LUMA = np.array([LUMA_RED, LUMA_GREEN, LUMA_BLUE], dtype=np.float32)


class NumpyBackend(GaussNewton):
    """See AlignmentBackend."""

    def intensity(self, images: Tensor, min_silhouette: float) -> Tensor:
        """See AlignmentBackend."""
        return torch.from_numpy(intensity_of(images.numpy(), min_silhouette))

    def halve(self, level: FrameLevel, max_difference: float) -> FrameLevel:
        """See AlignmentBackend."""
        images = halve(level.intensity.numpy(), level.depth_m.numpy(), max_difference)
        return FrameLevel(level.camera.halved(), *(torch.from_numpy(image) for image in images))

    def model(self, level: FrameLevel) -> ModelLevel:
        """See AlignmentBackend."""
        images = model(level.camera, level.intensity.numpy(), level.depth_m.numpy())
        return ModelLevel(level.camera, *(torch.from_numpy(image) for image in images))

    def linearise(self, problem: LevelProblem) -> Linearisation:
        """See AlignmentBackend."""
        model, frame = problem.model, problem.frame
        sums = accumulate(
            (model.texture.numpy(), model.surface.numpy()),
            (frame.intensity.numpy(), frame.depth_m.numpy()),
            (model.camera, frame.camera),
            problem.T_model_frame,
            problem.parameters,
        )
        return Linearisation.from_sums(sums)


def intensity_of(images: Image, min_silhouette: float) -> Image:
    """Intensity [H, W] of a rendering [5, H, W], 0 where its silhouette is below a minimum."""
    return np.tensordot(LUMA, images[:3], 1) * (images[SILHOUETTE] >= min_silhouette)


def halve(intensity: Image, depth: Image, max_difference: float) -> tuple[Image, Image]:
    """Mean intensity and depth of the nearest surface in each 2x2 cell.

    Args:
        max_difference: depth differences beyond this fraction of the depth belong to another
            surface.
    """
    height, width = intensity.shape
    rows = np.minimum(2 * np.arange(max(1, height // 2))[:, None] + [0, 1], height - 1)
    columns = np.minimum(2 * np.arange(max(1, width // 2))[:, None] + [0, 1], width - 1)
    taps = np.stack([depth[np.ix_(rows[:, a], columns[:, b])] for a in (0, 1) for b in (0, 1)])
    grey = np.stack([intensity[np.ix_(rows[:, a], columns[:, b])] for a in (0, 1) for b in (0, 1)])
    nearest = np.where(taps > 0, taps, 1e30).min(axis=0)
    same = (taps > 0) & (taps - nearest <= max_difference * nearest)
    count = same.sum(axis=0)
    inverse = (same / np.where(same, taps, 1.0)).sum(axis=0)
    depth = np.where(count > 0, count / np.maximum(inverse, 1e-9), 0.0)
    surface_mean = (grey * same).sum(axis=0) / np.maximum(count, 1)
    intensity = np.where(count > 0, surface_mean, grey.mean(axis=0))
    return intensity.astype(np.float32), depth.astype(np.float32)


def model(camera: Camera, intensity: Image, depth: Image) -> tuple[Image, Image]:
    """Texture and surface [H, W, 4] of one level; see ModelLevel."""
    texture = np.zeros((*depth.shape, 4), dtype=np.float32)
    surface = np.zeros_like(texture)
    if min(depth.shape) < 3:
        return texture, surface
    inner = (slice(1, -1), slice(1, -1))
    z = depth[inner]
    left, right = depth[1:-1, :-2], depth[1:-1, 2:]
    above, below = depth[:-2, 1:-1], depth[2:, 1:-1]
    usable = np.min([z, left, right, above, below], axis=0) > 0
    parts = (
        intensity[inner],
        0.5 * (intensity[1:-1, 2:] - intensity[1:-1, :-2]),
        0.5 * (intensity[2:, 1:-1] - intensity[:-2, 1:-1]),
        z,
    )
    texture[inner] = np.stack(parts, axis=-1) * usable[..., None]
    smooth = usable & _same_surface(left, z, right) & _same_surface(above, z, below)
    rays = camera.rays()[inner].astype(np.float32)
    unit = np.eye(3, dtype=np.float32)
    along_x = rays * (0.5 * (right - left))[..., None] + z[..., None] / camera.fx * unit[0]
    along_y = rays * (0.5 * (below - above))[..., None] + z[..., None] / camera.fy * unit[1]
    normal = np.cross(along_x, along_y)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    offset = (normal * rays).sum(axis=-1, keepdims=True) * z[..., None]
    surface[inner] = np.concatenate([normal, offset], axis=-1) * smooth[..., None]
    return texture, surface


def _same_surface(a: Image, z: Image, b: Image) -> NDArray[np.bool_]:
    """Check whether a pixel of depth z and its neighbours a and b belong to one surface.

    They do if their depths are similar, or if they lie on a plane of any slope: inverse depth is
    linear in the image coordinates of a plane.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = abs(z / a + z / b - 2.0)
    return (abs(b - a) <= MAX_DEPTH_STEP * z) | (bend <= 0.5 * MAX_DEPTH_STEP)


def accumulate(
    model_images: tuple[Image, Image],
    frame_images: tuple[Image, Image],
    cameras: tuple[Camera, Camera],
    T_model_frame: NDArray[np.float64],
    scalars: tuple[float, float, float, float, float, float],
) -> NDArray[np.float64]:
    """Compute the 49 sums of the native kernel; see `Linearisation.from_sums`.

    Args:
        model_images: texture and surface [H, W, 4].
        frame_images: intensity and depth [H, W].
        cameras: of the model view and of the frame.
        T_model_frame: [4, 4].
        scalars: gain, bias, intensity scale, depth scale, depth gate, photometric weight.
    """
    texture, surface = model_images
    intensity, depth = frame_images
    model_camera, frame_camera = cameras
    gain, bias, sigma_intensity, sigma_depth, gate, weight = scalars
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns].astype(np.float64)
    frame_intensity = intensity[rows, columns].astype(np.float64)
    X = frame_camera.rays()[rows, columns] * z[:, None]
    Y = X @ T_model_frame[:3, :3].T + T_model_frame[:3, 3]
    ahead = Y[:, 2] > NEAR_M
    uv = model_camera.project(np.where(ahead[:, None], Y, [0.0, 0.0, 1.0]))
    inside = ahead & (uv >= 0).all(axis=1)
    inside &= (uv[:, 0] < model_camera.width - 1) & (uv[:, 1] < model_camera.height - 1)
    Y, uv, frame_intensity = Y[inside], uv[inside], frame_intensity[inside]
    nearest = (uv + 0.5).astype(int)
    plane = surface[nearest[:, 1], nearest[:, 0]].astype(np.float64)
    model_depth = texture[nearest[:, 1], nearest[:, 0], 3]
    close = (model_depth > 0) & (abs(model_depth - Y[:, 2]) < gate * model_depth)

    H, g, tail = np.zeros((8, 8)), np.zeros(8), np.zeros(5)
    tail[4] = len(Y)
    flat = close & plane[:, :3].any(axis=1)
    n = plane[flat, :3]
    # Weight and lever arm are computed from the model's depth. With the frame's depth they would
    # depend on its noise, nearer points would have a larger weight, and the pose would be biased.
    scale = 1.0 / (sigma_depth * np.maximum(model_depth[flat] ** 2, MIN_NOISE_DEPTH_M**2))
    X = Y[flat] * (model_depth[flat] / Y[flat, 2])[:, None]
    residual = (n * Y[flat]).sum(axis=1) - plane[flat, 3]
    _add(H, g, tail, 1, (_jacobian(n, X), residual, scale), 1.0)

    value, usable = _bilinear(texture, surface[..., 3] != 0, uv[close])
    Y, value = Y[close][usable], value[usable]
    frame_intensity = frame_intensity[close][usable]
    a = value[:, 1] * model_camera.fx / Y[:, 2]
    b = value[:, 2] * model_camera.fy / Y[:, 2]
    slope = np.stack([a, b, -(a * Y[:, 0] + b * Y[:, 1]) / Y[:, 2]], axis=1)
    J = np.concatenate(
        [
            _jacobian(slope, Y)[:, :6],
            -frame_intensity[:, None],
            -np.ones_like(frame_intensity)[:, None],
        ],
        axis=1,
    )
    residual = value[:, 0] - (gain * frame_intensity + bias)
    scale = np.full(len(frame_intensity), 1.0 / sigma_intensity)
    _add(H, g, tail, 0, (J, residual, scale), weight)
    return np.concatenate([H[np.triu_indices(8)], g, tail])


def _jacobian(direction: NDArray, Y: NDArray) -> NDArray:
    """Derivative [n, 8] of direction . Y with respect to a left tangent; 0 for the exposure."""
    return np.concatenate([direction, np.cross(Y, direction), np.zeros((len(Y), 2))], axis=1)


def _add(
    H: NDArray,
    g: NDArray,
    tail: NDArray,
    kind: int,
    residuals: tuple[NDArray, ...],
    term_weight: float,
) -> None:
    """Add weighted residuals (J, r, 1 / scale) to the sums, in place."""
    J, r, inverse = residuals
    q2 = (r * inverse) ** 2
    robust = (STUDENT_T_DOF + 1.0) / (STUDENT_T_DOF + q2)
    weight = term_weight * robust * inverse**2
    H += (J * weight[:, None]).T @ J
    g += J.T @ (weight * r)
    tail[kind] += len(r)
    tail[2 + kind] += (robust * q2).sum()


def _bilinear(
    texture: Image, smooth: NDArray[np.bool_], uv: NDArray
) -> tuple[NDArray, NDArray[np.bool_]]:
    """Interpolated texture [n, 4], and whether the four taps belong to one surface [n].

    Args:
        smooth: [H, W] pixels that belong to one plane with all their neighbours. If two opposite
            taps do, all four belong to one surface.
    """
    x, y = uv[:, 0].astype(int), uv[:, 1].astype(int)
    a, b = (uv[:, 0] - x)[:, None], (uv[:, 1] - y)[:, None]
    taps = [texture[y, x], texture[y, x + 1], texture[y + 1, x], texture[y + 1, x + 1]]
    depths = np.stack([t[:, 3] for t in taps])
    nearest, farthest = depths.min(axis=0), depths.max(axis=0)
    connected = smooth[y, x] & smooth[y + 1, x + 1]
    usable = (nearest > 0) & (connected | (farthest - nearest <= MAX_DEPTH_STEP * nearest))
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    return sum(w * t for w, t in zip(weights, taps, strict=True)), usable
