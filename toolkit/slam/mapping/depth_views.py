"""Depth images of keyframes as evidence about space: what they measured as empty, how reliably."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.free_space import free_space_margin_m
from toolkit.base.keyframe import Keyframe
from toolkit.base.native import address, kernels, kernels_for

# Distance in metres up to which depth has full confidence; the noise of triangulation grows with
# the square of the distance.
_FULL_CONFIDENCE_M = 3.0
# Confidence of a surface at a grazing angle, relative to one that faces the camera.
_MIN_OBLIQUE = 0.2
# Nearer points are ignored.
MIN_DEPTH_M = 0.05
# Maximum number of depth images in the cache: several times those compared with a keyframe.
_MAX_IMAGES = 32


@dataclass(frozen=True, eq=False)
class DepthImage:
    """A depth image, and what follows from it alone, computed when it is first needed.

    Attributes:
        camera: intrinsics of the image.
        depth_m: [H, W] measured depth, 0 where missing.
    """

    camera: Camera
    depth_m: NDArray[np.float32]

    @classmethod
    def of(cls, keyframe: Keyframe) -> DepthImage:
        """The depth that a keyframe measured."""
        return cls(keyframe.camera, keyframe.measured_m.numpy())

    @classmethod
    def missing(cls, camera: Camera) -> DepthImage:
        """An image that measured nothing, as of a frame that is not kept."""
        return cls(camera, np.zeros((camera.height, camera.width), np.float32))

    @cached_property
    def empty_m(self) -> NDArray[np.float32]:
        """Depth [H, W] up to which space is empty; see `empty_depth`."""
        return empty_depth(self.depth_m)

    @cached_property
    def confidence(self) -> NDArray[np.float32]:
        """Confidence [H, W] of the depth; see `depth_confidence`."""
        return depth_confidence(self.depth_m, self.camera)


@dataclass(frozen=True, eq=False)
class DepthView:
    """The depth image of a keyframe, and its pose in a map.

    Attributes:
        T_camera_map: [4, 4] float32.
    """

    T_camera_map: NDArray[np.float32]
    image: DepthImage

    @classmethod
    def of(cls, keyframe: Keyframe, T_map_submap: NDArray[np.float64] | None = None) -> DepthView:
        """The view of a keyframe.

        Args:
            T_map_submap: [4, 4] pose of the keyframe's submap, the identity by default.
        """
        T_map_camera = keyframe.T_map_camera
        if T_map_submap is not None:
            T_map_camera = T_map_submap @ T_map_camera
        return cls.at(T_map_camera, DepthImage.of(keyframe))

    @classmethod
    def at(cls, T_map_camera: NDArray[np.float64], image: DepthImage) -> DepthView:
        """A depth image at a pose [4, 4]."""
        return cls(se3.inverse(T_map_camera).astype(np.float32), image)

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """Measured depth [H, W], 0 where missing."""
        return self.image.depth_m

    @property
    def geometry(self) -> tuple[tuple[float, ...], tuple[int, int], NDArray[np.float64]]:
        """Intrinsics, size [W, H] and pose [12] in the form that the kernels expect."""
        camera = self.image.camera
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        T = self.T_camera_map[:3].astype(np.float64).ravel()
        return intrinsics, (camera.width, camera.height), T

    def pixels_of(self, means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Indices [n] of the points [N, 3] in the image, their pixels by row, and their depths."""
        camera, T = self.image.camera, self.T_camera_map
        # Products of matrices may be rounded differently at another address.
        x, y, z = (
            (means[:, 0] * float(row[0]))
            .add_(means[:, 1] * float(row[1]))
            .add_(means[:, 2] * float(row[2]))
            .add_(float(row[3]))
            for row in T[:3]
        )
        inverse = 1.0 / z.clamp(min=MIN_DEPTH_M)
        u = (x.mul_(inverse) * camera.fx).add_(camera.cx + 0.5)
        v = (y.mul_(inverse) * camera.fy).add_(camera.cy + 0.5)
        inside = (z > MIN_DEPTH_M) & (u >= 0) & (v >= 0)
        inside &= (u < camera.width) & (v < camera.height)
        chosen = inside.nonzero().squeeze(1)
        z, u, v = (a.index_select(0, chosen) for a in (z, u, v))
        return chosen, v.long() * camera.width + u.long(), z

    @property
    def box(self) -> NDArray[np.float64]:
        """Corners [2, 3] of a box in the map outside of which the view measured nothing."""
        farthest = self.depth_m.max(initial=0.0, keepdims=True)
        depth_m = float((farthest + free_space_margin_m(farthest)).item())
        camera = self.image.camera
        columns, rows = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
        x, y = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
        corners = depth_m * np.stack([x.ravel(), y.ravel(), np.ones(4)], axis=1)
        T = se3.inverse(self.T_camera_map.astype(np.float64))
        points = np.concatenate([np.zeros((1, 3)), corners]) @ T[:3, :3].T + T[:3, 3]
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def measures_through(self, means: Tensor) -> Tensor:
        """Mask [N] of the points [N, 3] on the CPU in space that was measured as empty."""
        module = kernels_for(means)
        if module is not None:
            marks = torch.empty(len(means), dtype=torch.bool)
            points, empty = means.contiguous(), torch.from_numpy(self.image.empty_m)
            module.mark_empty(
                address(points),
                len(points),
                *self.geometry,
                address(empty),
                MIN_DEPTH_M,
                address(marks),
            )
            return marks
        chosen, pixel, z = self.pixels_of(means)
        empty = torch.from_numpy(self.image.empty_m.reshape(-1)).index_select(0, pixel)
        mask = torch.zeros(len(means), dtype=torch.bool)
        mask[chosen] = z < empty
        return mask


class DepthViews:
    """The depth views of keyframes, whose images are prepared once."""

    def __init__(self) -> None:
        self._images: LruCache[DepthImage] = LruCache(_MAX_IMAGES)

    def of(self, keyframe: Keyframe) -> DepthView:
        """The view of a keyframe at its present pose."""
        # Moving objects may have been removed, and keyframes of other submaps may have the same
        # index.
        sources = (keyframe.depth_m, keyframe.inferred)
        image = self._images.get(keyframe.index, lambda: DepthImage.of(keyframe), sources)
        return DepthView.at(keyframe.T_map_camera, image)


def empty_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] up to which each pixel of a depth image measured empty space.

    It is the smallest depth of the pixel and its neighbours, less a margin, and 0 where any of them
    is missing: beside a depth edge, a point belongs to the near surface.
    """
    nearest = cv2.erode(depth_m, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return (nearest - free_space_margin_m(nearest)).clip(0.0).astype(np.float32)


def depth_confidence(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Confidence [H, W] in [0, 1] of measured depth [H, W], from obliqueness and distance."""
    module = kernels()
    if module is None:
        return _depth_confidence_opencv(depth_m, camera)
    depth_m = np.ascontiguousarray(depth_m)
    confidence = np.empty(depth_m.shape, np.float32)
    module.depth_confidence(
        depth_m.ctypes.data,
        (camera.width, camera.height),
        (camera.fx, camera.fy, _FULL_CONFIDENCE_M, _MIN_OBLIQUE),
        confidence.ctypes.data,
    )
    return confidence


def _depth_confidence_opencv(depth_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """As `depth_confidence`, with OpenCV: reference and fallback of the native kernel."""
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
