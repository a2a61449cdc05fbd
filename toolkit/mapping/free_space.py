"""Free space: removes Gaussians from space that keyframes measured as empty.

The measured depth of a keyframe states that nothing lies in front of it. Wrong depth (at edges, of
glass and plants, filled in by the device, or from matching beside object borders) places Gaussians
in such space, where they hide what other keyframes see behind them. A Gaussian is removed if the
keyframes that measured through it outweigh those that measured a surface at its place.

Each measurement has a confidence: it decreases with the obliqueness of the surface and with the
distance, and it is 0 beside depth edges, where a pixel may belong to either side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.keyframe import FREE_SPACE, FREE_SPACE_M, Keyframe, evenly_spaced
from toolkit.mapping.options import FreeSpaceOptions

# Distance in metres up to which depth has full confidence; the noise of triangulation grows with
# the square of the distance.
_FULL_CONFIDENCE_M = 3.0
# Confidence of a surface at a grazing angle, relative to one that faces the camera.
_MIN_OBLIQUE = 0.2
_MIN_DEPTH_M = 0.05
# Maximum fraction of the seeds of a keyframe that earlier keyframes may rule out.
_MAX_DROPPED = 0.2


@dataclass(frozen=True)
class DepthView:
    """The depth image of a keyframe, and its pose in a map.

    Attributes:
        T_camera_map: [4, 4] float32.
        camera: intrinsics of the image.
        depth_m: [H, W] measured depth, 0 where missing.
    """

    T_camera_map: NDArray[np.float32]
    camera: Camera
    depth_m: NDArray[np.float32]

    @classmethod
    def of(cls, keyframe: Keyframe, T_map_submap: NDArray[np.float64] | None = None) -> DepthView:
        """The view of a keyframe.

        Args:
            T_map_submap: [4, 4] pose of the keyframe's submap, the identity by default.
        """
        T_map_camera = keyframe.T_map_camera
        if T_map_submap is not None:
            T_map_camera = T_map_submap @ T_map_camera
        T_camera_map = se3.inverse(T_map_camera).astype(np.float32)
        return cls(T_camera_map, keyframe.camera, keyframe.measured_m.numpy())

    def pixels_of(self, means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Indices [n] of the points [N, 3] in the image, their pixels by row, and their depths."""
        camera, T = self.camera, self.T_camera_map
        axes = (means @ torch.from_numpy(T[:3, :3].T.copy()).to(means)).unbind(dim=1)
        x, y, z = (axis + float(shift) for axis, shift in zip(axes, T[:3, 3], strict=True))
        inverse = 1.0 / z.clamp(min=_MIN_DEPTH_M)
        u = (x.mul_(inverse) * camera.fx).add_(camera.cx + 0.5)
        v = (y.mul_(inverse) * camera.fy).add_(camera.cy + 0.5)
        inside = (z > _MIN_DEPTH_M) & (u >= 0) & (v >= 0)
        inside &= (u < camera.width) & (v < camera.height)
        chosen = inside.nonzero().squeeze(1)
        z, u, v = (a.index_select(0, chosen) for a in (z, u, v))
        return chosen, v.long() * camera.width + u.long(), z


@dataclass(frozen=True)
class Evidence:
    """Evidence about N points: sums over keyframes.

    Attributes:
        through: [N] confidences of the keyframes that measured a surface behind the point.
        support: [N] number of the keyframes that measured a surface at the point.
    """

    through: Tensor
    support: Tensor

    @classmethod
    def of(cls, means: Tensor, views: Iterable[DepthView], whole_map: bool = True) -> Evidence:
        """Evidence of views about points [N, 3].

        Args:
            whole_map: the points are those of a map, so that the reliability of each view follows
                from them. Otherwise views are reliable.
        """
        evidence = cls(means.new_zeros(len(means)), means.new_zeros(len(means)))
        for view in views:
            evidence.add(view, means, whole_map)
        return evidence

    def add(self, view: DepthView, means: Tensor, whole_map: bool) -> None:
        """Add the evidence of a view about the points [N, 3], in place."""
        chosen, pixel, z = view.pixels_of(means)
        if not len(chosen):
            return
        depth_m = view.depth_m
        depth, empty, confidence = (
            torch.from_numpy(image.reshape(-1)).to(means.device).index_select(0, pixel)
            for image in (depth_m, empty_depth(depth_m), depth_confidence(depth_m, view.camera))
        )
        margin = (FREE_SPACE * depth).clamp_(min=FREE_SPACE_M)
        # Beside edges, a surface is as well measured as elsewhere; only its border is not.
        near, through = (depth > 0) & ((z - depth).abs() <= margin), z < empty
        reliability = 1.0
        if whole_map:
            # A keyframe at a wrong pose or with wrong depth contradicts much of the map.
            agreeing, contradicting = int(near.sum()), int(through.sum())
            reliability = (agreeing / max(agreeing + contradicting, 1)) ** 2
        self.through.index_add_(0, chosen, reliability * confidence * through)
        self.support.index_add_(0, chosen, near.to(means.dtype))

    def contradicts(self, options: FreeSpaceOptions) -> Tensor:
        """Mask [N] of the points in empty space."""
        enough = self.through >= options.min_through
        return enough & (self.through > options.min_ratio * self.support)


def contradicted(
    means: Tensor, newest: Keyframe, others: Sequence[Keyframe], options: FreeSpaceOptions
) -> Tensor:
    """Mask [N] of the points in empty space, of those that the newest keyframe measured through.

    Args:
        means: [N, 3] points.
        others: earlier keyframes of the same map; at most `options.views` of them are compared.
    """
    through = Evidence.of(means, [DepthView.of(newest)]).through
    mask = through > 0
    candidates = mask.nonzero().squeeze(1)
    some = means.index_select(0, candidates)
    evidence = Evidence.of(some, _views(others, options), whole_map=False)
    evidence.through.add_(through.index_select(0, candidates))
    return mask.index_copy(0, candidates, evidence.contradicts(options))


def seen_through(seeds: Tensor, others: Sequence[Keyframe], options: FreeSpaceOptions) -> Tensor:
    """Mask [N] of the points that earlier keyframes contradict; none if they contradict many.

    Args:
        seeds: [N, 3] points that a new keyframe measured.
        others: as in `contradicted`.
    """
    evidence = Evidence.of(seeds, _views(others, options), whole_map=False)
    evidence.support.add_(1.0)
    mask = evidence.contradicts(options)
    # Then the pose of the new keyframe is in doubt, not its depth.
    return mask if mask.sum() <= _MAX_DROPPED * len(mask) else torch.zeros_like(mask)


def _views(keyframes: Sequence[Keyframe], options: FreeSpaceOptions) -> list[DepthView]:
    return [DepthView.of(keyframe) for keyframe in evenly_spaced(keyframes, options.views)]


def empty_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] up to which each pixel of a depth image measured empty space.

    It is the smallest depth of the pixel and its neighbours, less a margin, and 0 where any of them
    is missing: beside a depth edge, a point belongs to the near surface.
    """
    nearest = cv2.erode(depth_m, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return (nearest - np.maximum(FREE_SPACE_M, FREE_SPACE * nearest)).clip(0.0).astype(np.float32)


def depth_confidence(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Confidence [H, W] in [0, 1] of measured depth [H, W], from obliqueness and distance."""
    known = depth_m > 0
    inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=known)
    smooth = cv2.blur(inverse, (3, 3))
    # Inverse depth is linear on a plane; its slope per unit of the ray is the plane's tilt.
    slope_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1.0 / 8.0) * camera.fx
    slope_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1.0 / 8.0) * camera.fy
    tilt = np.hypot(slope_u, slope_v) * depth_m
    facing = np.maximum(1.0 / np.sqrt(1.0 + tilt**2), _MIN_OBLIQUE)
    near = np.minimum(1.0, (_FULL_CONFIDENCE_M * inverse) ** 2)
    return np.asarray(known * facing * near, np.float32)
