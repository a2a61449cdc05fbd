"""Masks from depth, colour and class labels alone: smooth surfaces of one class.

Pixels are connected across a border if depth, normal and class agree. Without classes, furniture
falls into its surfaces; the merging of objects over views joins those that other views connect.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.regions import connected_regions
from toolkit.base.keyframe import Keyframe
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.scene.instances.voxels import sampled, sampling_step

# A step in depth between neighbours: a fraction of the depth per pixel, in addition to the slope
# of the surface.
_STEP = 0.03
# Without classes, surfaces end where they bend by more than this angle (a cosine) ...
_BEND = 0.9
# ... or where colours differ by more than this, in 0 to 255.
_COLOUR = 40.0
# Minimum number of sampled pixels of a segment.
_MIN_PIXELS = 15


class GeometricMasks:
    """Segments of smooth surfaces of one class, as masks without classes and embeddings.

    With class labels, a segment is a connected region of one class without a step in depth;
    without labels, it also ends at folds and at edges of colour.

    Args:
        labels: how the class labels of keyframes are used; if they are required, keyframes without
            them have no masks.
    """

    def __init__(self, labels: Literal["used", "required", "ignored"] = "used") -> None:
        self._labels = labels

    def masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        """Return the segments of a keyframe."""
        if self._labels == "required" and keyframe.class_ids is None:
            return None
        step = sampling_step(keyframe.camera.width)  # more pixels are not compared
        depth_m = np.ascontiguousarray(sampled(keyframe.depth_m.numpy(), step))
        labels = None
        if self._labels != "ignored" and keyframe.class_ids is not None:
            labels = sampled(keyframe.class_ids.numpy(), step)
        smooth = depth_m > 0
        smooth &= ~depth_steps(depth_m)
        if labels is None or not labels.any():
            rgb = sampled(keyframe.rgb.numpy(), step).transpose(1, 2, 0)
            smooth &= ~_folds(depth_m, keyframe.camera, step)
            smooth &= ~_colour_edges(np.ascontiguousarray(rgb))
            classes = smooth.astype(np.int32)
        else:
            classes = np.where(smooth, labels, 0).astype(np.int32)
        segments, _ = connected_regions(classes, connectivity=4, min_pixels=_MIN_PIXELS)
        segments = _grown(segments, depth_m > 0, labels)
        rows, columns = (
            np.minimum(np.arange(pixels) // step, samples - 1)
            for pixels, samples in zip(keyframe.depth_m.shape, segments.shape, strict=True)
        )
        count = int(segments.max(initial=0))
        return InstanceMasks(
            segments[rows][:, columns],
            [None] * count,
            np.ones(count, np.float32),
            np.zeros((count, 0), np.float32),
        )


def depth_steps(depth_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask of the pixels beside a step in depth."""
    z = np.where(depth_m > 0, depth_m, np.nan)
    edges = np.zeros(z.shape, bool)
    inverse = 1.0 / z  # linear in the image on a plane
    for axis in (0, 1):
        bend = np.abs(np.diff(inverse, n=2, axis=axis))
        inner = np.s_[1:-1] if axis == 0 else np.s_[:, 1:-1]
        edges[inner] |= bend * z[inner] > _STEP
    return edges


def _folds(depth_m: NDArray[np.float32], camera: Camera, step: int) -> NDArray[np.bool_]:
    """Mask of the pixels where the normal changes between their neighbours."""
    z = cv2.GaussianBlur(depth_m, (0, 0), 1.0)
    rays = camera.rays(step).astype(np.float32)
    x, y = rays[..., 0] * z, rays[..., 1] * z
    across = [channel[1:-1, 2:] - channel[1:-1, :-2] for channel in (x, y, z)]
    down = [channel[2:, 1:-1] - channel[:-2, 1:-1] for channel in (x, y, z)]
    normal = [across[i] * down[j] - across[j] * down[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    length = np.sqrt(sum(n * n for n in normal)) + np.float32(1e-9)
    normal = [n / length for n in normal]
    folds = np.zeros(depth_m.shape, bool)
    folds[1:-1, 2:-2] |= sum(n[:, 2:] * n[:, :-2] for n in normal) < _BEND
    folds[2:-2, 1:-1] |= sum(n[2:] * n[:-2] for n in normal) < _BEND
    return folds


def _colour_edges(rgb: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Mask of the pixels at strong edges of the smoothed colour."""
    smoothed = cv2.bilateralFilter(rgb, 5, 30.0, 3.0).astype(np.float32)
    edges = np.zeros(rgb.shape[:2], bool)
    for channel in cv2.split(smoothed):
        edges[:, 1:-1] |= np.abs(channel[:, 2:] - channel[:, :-2]) > _COLOUR
        edges[1:-1] |= np.abs(channel[2:] - channel[:-2]) > _COLOUR
    return edges


def _grown(
    segments: NDArray[np.int32], valid: NDArray[np.bool_], labels: NDArray[np.integer] | None
) -> NDArray[np.int32]:
    """Segments grown over the edges between them by two pixels, within their class."""
    for _ in range(2):
        grown = cv2.dilate(segments.astype(np.uint16), np.ones((3, 3))).astype(np.int32)
        free = valid & (segments == 0)
        if labels is not None:
            owner = np.zeros(int(grown.max()) + 1, np.int64)
            inside = segments > 0
            owner[segments[inside]] = labels[inside]
            free &= owner[grown] == labels
        segments = np.where(free, grown, segments)
    return segments
