"""Depth of keyframes from the keyframes around them.

A plane sweep gives each keyframe a depth nearly everywhere, and wrong depth where there is no
texture, behind edges and on reflections. Two keyframes seldom make the same mistake: only depth
that the keyframes around agree with is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.coarse_to_fine import (
    ImagePair,
    Source,
    SweptDepth,
    image_pair,
    sweep_depth,
)
from toolkit.depth.depth_priors.consensus import AgreementOptions, find_consensus, relative_sigma
from toolkit.depth.depth_priors.plane_completion import complete, is_smooth
from toolkit.depth.depth_priors.problem import Image, NeighbourView

Array = NDArray[np.float64]

# The range of a sweep is wider than that of the known points.
_NEARER, _FARTHER = 1.6, 2.5
# Keyframes on each side that a keyframe is compared with, and those also used for the first, coarse
# estimate: more of them change neither its density nor its errors.
_AROUND = 3
_COARSE = (-3, -1, 1, 3)
_CACHED = 6 * _AROUND
# Where the intensity changes slowly, noise and blocks of compression agree at some depth by chance:
# four fifths of what fits less clearly is wrong in a film of plain walls.
_MIN_MARGIN, _MIN_DENSITY, _WINDOW = 0.02, 0.6, 15


@dataclass(frozen=True)
class SweptKeyframe:
    """A keyframe whose depth is estimated.

    Attributes:
        frame: index of its image.
        T_world_camera: [4, 4].
        near, far: depths of its nearest and farthest known points.
        points: [N, 3] column and row in pixels, and depth, of points that were triangulated.
    """

    frame: int
    T_world_camera: Array
    near: float
    far: float
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def scaled(self, T_world_camera: Array, factor: float) -> SweptKeyframe:
        """The same keyframe in a unit of length that is `factor` times as short.

        Args:
            T_world_camera: [4, 4] in this unit.
        """
        points = self.points * [1.0, 1.0, factor]
        near, far = factor * self.near, factor * self.far
        return SweptKeyframe(self.frame, T_world_camera, near, far, points)


@dataclass(frozen=True)
class EstimatedDepth:
    """Depth of a keyframe.

    Attributes:
        depth: [H, W] float32 z-depth in the unit of the poses, 0 where unknown.
        inferred: [H, W] bool, where depth is not measured, but completed by a plane.
        relative_sigma: [H, W] float32 relative standard deviation at known poses, inf where the
            depth is unknown.
    """

    depth: Image
    inferred: NDArray[np.bool_]
    relative_sigma: Image


class MultiViewDepth:
    """Estimates the depth of keyframes on demand; fastest in ascending order.

    Args:
        camera: intrinsics of all images.
        views: keyframes in order.
        intensity: returns the image [H, W] float32 in [0, 1] of a frame index.
    """

    def __init__(
        self,
        camera: Camera,
        views: Sequence[SweptKeyframe],
        intensity: Callable[[int], Image],
    ) -> None:
        self._camera, self._views, self._intensity = camera, views, intensity
        self._agreement = AgreementOptions()
        self._images: LruCache[ImagePair] = LruCache(_CACHED)
        self._swept: LruCache[SweptDepth] = LruCache(_CACHED)
        self._completed: LruCache[EstimatedDepth] = LruCache(_CACHED)

    def depth(self, number: int) -> Image:
        """Depth [H, W] of a keyframe that others confirm, 0 elsewhere, in the unit of the poses."""
        return self.measured(number).depth

    def measured(self, number: int) -> EstimatedDepth:
        """Depth of a keyframe that others confirm, and its accuracy."""
        own, around = self._sweep(number), self._around(number)
        others = [
            NeighbourView(self._sweep(n).inverse_depth, self._T_from_to(number, n)) for n in around
        ]
        found = find_consensus(self._camera, own.inverse_depth, others, self._agreement)
        needed = min(self._agreement.keyframes, len(others))
        known = (found.inverse_depth > 0) & (found.agreeing >= needed + found.conflicting)
        unclear = (own.margin < _MIN_MARGIN) & is_smooth(self._image(number).full)
        known &= ~unclear | (_density(known) > _MIN_DENSITY)
        sigma = np.where(known, relative_sigma(found, own.margin), np.float32(np.inf))
        inverse_depth = np.where(known, found.inverse_depth, np.float32(0.0))
        return EstimatedDepth(_inverse(inverse_depth), np.zeros(known.shape, bool), sigma)

    def completed(self, number: int) -> EstimatedDepth:
        """Measured depth of a keyframe, completed on planes that other keyframes confirm."""
        own, others = self._planar(number), []
        for n in self._around(number):
            inverse_depth = _inverse(self._planar(n).depth)
            others.append(NeighbourView(inverse_depth, self._T_from_to(number, n)))
        found = find_consensus(self._camera, _inverse(own.depth), others, self._agreement)
        needed = np.minimum(found.conflicting + 1, len(others))
        kept = ~own.inferred | (found.agreeing >= needed)
        return EstimatedDepth(
            np.where(kept, own.depth, np.float32(0.0)),
            own.inferred & kept,
            np.where(kept, own.relative_sigma, np.float32(np.inf)),
        )

    def _planar(self, number: int) -> EstimatedDepth:
        """Measured depth of a keyframe, completed on planes."""
        return self._completed.get(number, lambda: self._new_planar(number))

    def _new_planar(self, number: int) -> EstimatedDepth:
        measured = self.measured(number)
        image, inverse_depth = self._image(number).full, _inverse(measured.depth)
        found = complete(image, inverse_depth, np.random.default_rng(number))
        inferred = found.inverse_depth > 0
        return EstimatedDepth(
            np.where(inferred, _inverse(found.inverse_depth), measured.depth),
            inferred,
            np.where(inferred, found.relative_sigma, measured.relative_sigma),
        )

    def _around(self, number: int) -> list[int]:
        first, last = max(0, number - _AROUND), min(len(self._views) - 1, number + _AROUND)
        return [n for n in range(first, last + 1) if n != number]

    def _T_from_to(self, number: int, other: int) -> Array:
        T_world_other = self._views[other].T_world_camera
        return se3.inverse(T_world_other) @ self._views[number].T_world_camera

    def _sweep(self, number: int) -> SweptDepth:
        """Depth of a keyframe from the images around it."""
        return self._swept.get(number, lambda: self._new_sweep(number))

    def _new_sweep(self, number: int) -> SweptDepth:
        view = self._views[number]
        sources = [
            Source(self._image(n), self._T_from_to(number, n), n - number in _COARSE)
            for n in self._around(number)
        ]
        limits = 1.0 / (_FARTHER * view.far), _NEARER / view.near
        return sweep_depth(self._camera, self._image(number), sources, limits)

    def _image(self, number: int) -> ImagePair:
        view = self._views[number]
        return self._images.get(number, lambda: image_pair(self._intensity(view.frame)))


def _density(known: NDArray[np.bool_]) -> Image:
    """Share [H, W] of the pixels around each one that are known."""
    return np.asarray(cv2.blur(known.astype(np.float32), (_WINDOW, _WINDOW)))


def _inverse(image: Image) -> Image:
    """Depth from inverse depth or the reverse, 0 where unknown."""
    known = image > 0
    return np.where(known, 1.0 / np.where(known, image, np.float32(1.0)), np.float32(0.0))
