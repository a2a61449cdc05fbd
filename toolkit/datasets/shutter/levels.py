"""Small images of a frame for the alignment of rows: two pyramid levels with derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_SMOOTHING_PX = 0.7
# Normals are computed from the neighbours at this distance in pixels.
_REACH = 2
# Neighbours on one surface: their depth differs by less, and is bent by less (relative).
_MAX_STEP, _MAX_BEND = 0.1, 0.03
_MAX_SAMPLES = 1500


@dataclass(frozen=True, eq=False)
class ShutterLevel:
    """One pyramid level of a frame, and the pixels of it that are aligned to other frames.

    Attributes:
        camera: intrinsics of this level.
        intensity: [H, W] in [0, 1].
        gradients: [H, W, 2] derivatives of the intensity along x and y, per pixel.
        points: [H, W, 3] float32, metres, in the camera's frame; 0 without depth.
        normals: [H, W, 3] float32; 0 where the surface is unknown.
        samples: [N, 3] points of the aligned pixels.
        sample_intensity: [N] their intensities.
        sample_rows: [N] rows of the samples, from -0.5 at the upper end to 0.5 at the lower one.
    """

    camera: Camera
    intensity: Image
    gradients: Image
    points: Image
    normals: Image
    samples: Array
    sample_intensity: Array
    sample_rows: Array


def shutter_levels(frame: Frame, seed: int = 0) -> tuple[ShutterLevel, ShutterLevel]:
    """The level of a frame's own size, and that of half its size."""
    intensity = np.ascontiguousarray(frame.rgb @ _LUMA)
    camera, depth_m = frame.camera, frame.depth_m
    width, height = camera.width // 2, camera.height // 2
    half = cv2.resize(
        intensity[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
    )
    coarse = replace(
        camera,
        fx=camera.fx / 2,
        fy=camera.fy / 2,
        cx=(camera.cx - 0.5) / 2,
        cy=(camera.cy - 0.5) / 2,
        width=width,
        height=height,
    )
    half_depth_m = np.ascontiguousarray(depth_m[: 2 * height : 2, : 2 * width : 2])
    return (
        _level(camera, intensity, depth_m, seed),
        _level(coarse, np.asarray(half), half_depth_m, seed),
    )


def _level(camera: Camera, intensity: Image, depth_m: Image, seed: int) -> ShutterLevel:
    smooth = np.asarray(cv2.GaussianBlur(intensity, (0, 0), _SMOOTHING_PX))
    gradients = np.stack(
        [cv2.Scharr(smooth, cv2.CV_32F, x, y, scale=1 / 32) for x, y in ((1, 0), (0, 1))], axis=-1
    )
    x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
    y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)
    axes = x * depth_m, y[:, None] * depth_m, depth_m
    points, normals = np.stack(axes, axis=-1), _normals(*axes)
    chosen = np.flatnonzero(normals[..., 2])
    if len(chosen) > _MAX_SAMPLES:
        random = np.random.default_rng(seed)
        chosen = np.sort(random.choice(chosen, _MAX_SAMPLES, replace=False))
    rows = (chosen // camera.width + 0.5) / camera.height - 0.5
    return ShutterLevel(
        camera,
        smooth,
        gradients,
        points,
        normals,
        points.reshape(-1, 3)[chosen].astype(np.float64),
        smooth.ravel()[chosen].astype(np.float64),
        rows,
    )


def _normals(x: Image, y: Image, z: Image) -> Image:
    """Normals [H, W, 3] of the surface, 0 at its edges and where it is strongly curved.

    Args:
        x, y, z: [H, W] coordinates of its points.
    """
    r = _REACH
    inner = (slice(r, -r), slice(r, -r))
    left, right = (slice(r, -r), slice(None, -2 * r)), (slice(r, -r), slice(2 * r, None))
    above, below = (slice(None, -2 * r), slice(r, -r)), (slice(2 * r, None), slice(r, -r))
    centre = z[inner]
    smooth = centre > 0
    for before, after in ((left, right), (above, below)):
        a, b = z[before], z[after]
        smooth &= (a > 0) & (b > 0) & (np.abs(a - b) < _MAX_STEP * centre)
        smooth &= np.abs(a + b - 2.0 * centre) < _MAX_BEND * centre
    (a, b, c), (d, e, f) = (
        [(axis[after] - axis[before])[smooth] for axis in (x, y, z)]
        for before, after in ((left, right), (above, below))
    )
    crossed = np.stack([b * f - c * e, c * d - a * f, a * e - b * d], axis=-1)
    length = np.linalg.norm(crossed, axis=-1, keepdims=True)
    normals = np.zeros((*z.shape, 3), np.float32)
    normals[inner][smooth] = np.divide(crossed, length, out=crossed, where=length > 0)
    return normals
