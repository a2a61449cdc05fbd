"""Surfaces whose colour depends on the view, such as a polished floor, in the images of keyframes.

A reflection moves over its surface with the camera, and images that are aligned by it are aligned
to its mirror image instead. A surface point is view-dependent if its intensities in several
keyframes from different directions contradict each other by much more than those of the rest of
the image do. Keyframes from the same direction are no evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# About the number of columns of pixels that are compared.
_SAMPLES = 80
# Noise of an intensity (0-1), and difference of texture that is displaced or shown at another
# resolution, as a fraction of the local contrast. Only their ratio matters, since residuals are
# normalised. Gradients would miss texture one pixel wide: 7 % of a matt room would be masked.
_NOISE, _OF_CONTRAST = 0.005, 0.1
# Maximum difference of the depths of a surface in two keyframes, as a fraction of depth, and
# maximum ratio of the distances from which they see it.
_SAME_SURFACE, _MAX_ZOOM = 0.03, 1.6
# Angle in radians between two directions from which they are full evidence. Minimum sum of the
# evidence of all keyframes.
_FULL_ANGLE, _MIN_EVIDENCE = 0.1, 1.0
# Minimum root mean square of normalised residuals: the rest of the image has 1.
_MIN_CONTRADICTION = 3.0
# Where more of what was compared contradicts, the light has changed, or too little texture would
# be left to align by.
_MAX_SHARE = 0.5
# Minimum number of compared pixels of two keyframes.
_MIN_PIXELS = 50
# Intensity from which an image may be saturated.
_SATURATED = 0.97


@dataclass(frozen=True, eq=False)
class AlignedView:
    """A keyframe at a known pose, at one pyramid level.

    Attributes:
        T_map_camera: [4, 4].
        frame: its intensity and depth.
    """

    T_map_camera: Array
    frame: FrameLevel


def view_dependent(new: AlignedView, others: Sequence[AlignedView]) -> list[Mask | None]:
    """Where the images of other keyframes show view-dependent surfaces that a new one shows too.

    Args:
        new: its pose may be wrong by a pixel or two.

    Returns:
        A mask [H, W] for each of the others, or None where the mask is empty.
    """
    step = max(1, new.frame.camera.width // _SAMPLES)
    contrast = _contrast(new.frame)[::step, ::step]
    compared = [_compared(new, contrast, other, step) for other in others]
    shape = new.frame.depth_m.numpy()[::step, ::step].shape
    squares, evidence = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for pair in compared:
        squares += pair.evidence * pair.squares
        evidence += pair.evidence
    # A single pixel may be noise, or the edge of a highlight.
    squares, evidence = (cv2.blur(image, (3, 3)) for image in (squares, evidence))
    known = evidence >= _MIN_EVIDENCE
    mask = known & (squares > _MIN_CONTRADICTION**2 * evidence)
    if mask.sum() > _MAX_SHARE * known.sum():
        return [None] * len(others)
    return [
        _transferred(mask, pair, other, step) for pair, other in zip(compared, others, strict=True)
    ]


def without_gradient(level: ModelLevel, mask: Mask) -> ModelLevel:
    """A level whose intensity attracts no pose within a mask; its depth is kept.

    Args:
        mask: [h, w] at a level of any other size.
    """
    height, width = level.texture.shape[:2]
    resized = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    texture = level.texture.clone()
    texture[..., 1:3] *= torch.from_numpy(1.0 - resized.astype(np.float32))[..., None]
    return replace(level, texture=texture)


@dataclass(frozen=True, eq=False)
class _Compared:
    """Pixels [h, w] of a new keyframe, compared with another one.

    Attributes:
        squares: squared residuals, normalised to 1 for most of the image.
        evidence: from 0, not compared or seen from the same direction, to 1.
        pixels: [h, w] pixel of the other image by row, -1 where another surface is shown.
    """

    squares: NDArray[np.float32]
    evidence: NDArray[np.float32]
    pixels: NDArray[np.intp]


def _compared(
    new: AlignedView, own_contrast: NDArray[np.float32], other: AlignedView, step: int
) -> _Compared:
    """Compare every n-th pixel of a new keyframe, of known contrast [h, w], with another one."""
    z = new.frame.depth_m.numpy()[::step, ::step].astype(np.float64)
    own = new.frame.intensity.numpy()[::step, ::step]
    T_other_new = se3.inverse(other.T_map_camera) @ new.T_map_camera
    points = se3.transform_points(
        T_other_new, new.frame.camera.rays()[::step, ::step] * z[..., None]
    )
    camera, ahead = other.frame.camera, (z > 0) & (points[..., 2] > 0)
    uv = camera.project(np.where(ahead[..., None], points, [0.0, 0.0, 1.0]))
    inside = ahead & (uv >= 0).all(axis=-1)
    inside &= (uv[..., 0] <= camera.width - 1) & (uv[..., 1] <= camera.height - 1)
    column, row = np.moveaxis(np.rint(np.where(inside[..., None], uv, 0.0)).astype(np.intp), -1, 0)
    depth_m = other.frame.depth_m.numpy()[row, column]
    same = inside & (np.abs(points[..., 2] - depth_m) < _SAME_SURFACE * depth_m)
    zoom = points[..., 2] / np.where(same, z, 1.0)
    same &= (zoom < _MAX_ZOOM) & (zoom > 1.0 / _MAX_ZOOM)
    u, v = np.moveaxis(uv.astype(np.float32), -1, 0)
    shown = cv2.remap(other.frame.intensity.numpy(), u, v, cv2.INTER_LINEAR)
    same &= np.maximum(shown, own) < _SATURATED
    nothing = np.zeros(z.shape, np.float32)
    pixels = np.where(same, row * camera.width + column, -1)
    if same.sum() < _MIN_PIXELS:
        return _Compared(nothing, nothing, pixels)
    contrast = np.maximum(own_contrast, _contrast(other.frame)[row, column])
    residual = shown - own
    residual -= np.median(residual[same])
    squares = residual**2 / (_NOISE**2 + (_OF_CONTRAST * contrast) ** 2)
    # The median square of normally distributed residuals is 0.455 of their variance.
    usual = max(float(np.median(squares[same])) / 0.455, 1.0)
    angle = _angles(points, T_other_new[:3, 3])
    evidence = np.where(same, np.minimum(angle / _FULL_ANGLE, 1.0), 0.0)
    return _Compared((squares / usual).astype(np.float32), evidence.astype(np.float32), pixels)


def _contrast(level: FrameLevel) -> NDArray[np.float32]:
    """Range [H, W] of the intensities of each pixel and its neighbours."""
    intensity, around = level.intensity.numpy(), np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(intensity, around) - cv2.erode(intensity, around))


def _angles(points: Array, centre: Array) -> Array:
    """Angles [...] at which the origin and a centre [3] see points [..., 3], for small ones."""
    cross = np.linalg.norm(np.cross(points, points - centre), axis=-1)
    lengths = np.linalg.norm(points, axis=-1) * np.linalg.norm(points - centre, axis=-1)
    return np.asarray(cross / np.maximum(lengths, 1e-9))


def _transferred(mask: Mask, pair: _Compared, other: AlignedView, step: int) -> Mask | None:
    """The mask [h, w] of compared pixels in the other image [H, W]; None if it is empty there."""
    pixels = pair.pixels[mask & (pair.pixels >= 0)]
    if not len(pixels):
        return None
    found = np.zeros(other.frame.depth_m.shape, np.uint8)
    found.reshape(-1)[pixels] = 1
    side = 2 * step + 1
    return np.asarray(cv2.dilate(found, np.ones((side, side), np.uint8)) > 0)
