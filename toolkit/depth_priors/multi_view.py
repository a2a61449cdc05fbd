"""Depth of keyframes from the keyframes around them.

A plane sweep gives each keyframe a depth nearly everywhere, and wrong depth where there is no
texture, behind edges and on reflections. Two keyframes seldom make the same mistake: only depth
that the keyframes around agree with is kept.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.depth_priors.plane_sweep import SweepOptions, plane_sweep
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# The range of a sweep is wider than that of the known points.
_NEARER, _FARTHER = 1.6, 2.5
# Motion in the image from one plane to the next, for the farthest source.
_STEP_PX = 1.5
_MIN_PLANES, _MAX_PLANES = 48, 160
# Keyframes on each side that a keyframe is compared with.
_AROUND = 3
_CACHED = 4 * _AROUND


@dataclass(frozen=True)
class DepthView:
    """A keyframe whose depth is estimated.

    Attributes:
        frame: index of its image.
        T_world_camera: [4, 4].
        near, far: depths of its nearest and farthest known points.
    """

    frame: int
    T_world_camera: Array
    near: float
    far: float


@dataclass(frozen=True)
class AgreementOptions:
    """Which depth is kept.

    Attributes:
        tolerance: maximum relative difference to the depth of another keyframe.
        keyframes: number of keyframes that must agree.
    """

    tolerance: float = 0.02
    keyframes: int = 2


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
        views: Sequence[DepthView],
        intensity: Callable[[int], Image],
        agreement: AgreementOptions | None = None,
        sweep: SweepOptions | None = None,
    ) -> None:
        self._camera, self._views, self._intensity = camera, views, intensity
        self._agreement, self._sweep = agreement or AgreementOptions(), sweep or SweepOptions()
        self._images: OrderedDict[int, Image] = OrderedDict()
        self._depths: OrderedDict[int, Image] = OrderedDict()

    def depth(self, number: int) -> Image:
        """Depth [H, W] of a keyframe that others confirm, 0 elsewhere, in the unit of the poses."""
        own = self._swept(number)
        confirmed = np.zeros(own.shape, np.int32)
        points = self._camera.unproject(own)
        others = self._around(number)
        for other in others:
            confirmed += self._confirmed(points, own > 0, number, other)
        needed = min(self._agreement.keyframes, len(others))
        return np.where(confirmed >= needed, own, np.float32(0.0))

    def _around(self, number: int) -> list[int]:
        first, last = max(0, number - _AROUND), min(len(self._views) - 1, number + _AROUND)
        return [n for n in range(first, last + 1) if n != number]

    def _confirmed(
        self, points: Array, known: NDArray[np.bool_], number: int, other: int
    ) -> NDArray[np.bool_]:
        """Which points [H, W, 3] of a keyframe are on a surface of another one."""
        camera = self._camera
        T = self._T_from_to(number, other)
        seen = points @ T[:3, :3].T + T[:3, 3]
        known = known & (seen[..., 2] > 0)
        px = camera.project(np.where(known[..., None], seen, [0.0, 0.0, 1.0]))
        column, row = np.moveaxis(np.round(px).astype(np.int64), -1, 0)
        known &= (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        there = self._swept(other)[np.where(known, row, 0), np.where(known, column, 0)]
        near = np.abs(there - seen[..., 2]) < self._agreement.tolerance * seen[..., 2]
        return known & (there > 0) & near

    def _T_from_to(self, number: int, other: int) -> Array:
        T_world_other = self._views[other].T_world_camera
        return se3.inverse(T_world_other) @ self._views[number].T_world_camera

    def _swept(self, number: int) -> Image:
        """Depth [H, W] of a keyframe from the images around it, 0 where unknown."""
        return _cached(self._depths, number, self._sweep_of)

    def _sweep_of(self, number: int) -> Image:
        view = self._views[number]
        around = self._around(number)
        sources = [(self._image(n), self._T_from_to(number, n)) for n in around]
        baseline = max(float(np.linalg.norm(T[:3, 3])) for _, T in sources)
        far, near = 1.0 / (_FARTHER * view.far), _NEARER / view.near
        steps = baseline * self._camera.focal * (near - far) / _STEP_PX
        planes = int(np.clip(np.ceil(steps), _MIN_PLANES, _MAX_PLANES))
        image = self._image(number)
        inverse = plane_sweep(
            self._camera, image, sources, (far, near), planes, self._sweep
        ).inverse_depth
        known = inverse > 0
        depth = np.where(known, 1.0 / np.where(known, inverse, 1.0), 0.0)
        return depth.astype(np.float32)

    def _image(self, number: int) -> Image:
        return _cached(self._images, number, lambda n: self._intensity(self._views[n].frame))


def _cached(cache: OrderedDict[int, Image], number: int, compute: Callable[[int], Image]) -> Image:
    """A keyframe's image from a cache of the last computed ones."""
    if number not in cache:
        cache[number] = compute(number)
        while len(cache) > _CACHED:
            cache.popitem(last=False)
    return cache[number]
