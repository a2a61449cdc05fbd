"""Completes the depth of keyframes with priors where neighbouring keyframes do not agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.alignment import (
    MAX_SAMPLES,
    Correction,
    Samples,
    fit,
    fit_grid,
    samples_of,
)
from toolkit.depth.depth_priors.multi_view import SweptKeyframe
from toolkit.depth.depth_priors.options import DepthPriorOptions
from toolkit.depth.depth_priors.outliers import without_outliers
from toolkit.depth.depth_priors.provider import Image, Mask, PriorImage

# Keyframes on each side whose depth a prior is aligned to as well.
_AROUND = 2
# A prior must agree with this fraction of the known depth.
_MIN_INLIERS = 0.4
# Mean error of a useful prior relative to that of a constant depth; smaller errors always are.
_OF_CONSTANT, _MIN_ERROR = 0.85, 0.02
# Inferred depth is kept up to this factor outside the range of the known depth.
_RANGE = 1.5


@dataclass(frozen=True)
class CompletedDepth:
    """Depth of a keyframe.

    Attributes:
        depth: [H, W] float32, 0 where unknown.
        inferred: [H, W], where it follows from the prior.
    """

    depth: Image
    inferred: Mask


class DepthCompletion:
    """Aligns the prior of each keyframe with known depth, and fills the rest with it.

    Known depth is that of the keyframe itself and of the keyframes before and after it, moved to
    its pixels. The prior is aligned by one scale and shift, and then on a smooth grid.

    Args:
        camera: intrinsics of all keyframes.
        views: keyframes in order.
        depth: returns the depth [H, W] of a keyframe number, 0 where unknown.
        prior: returns the prior of a keyframe number.
        options: of the alignment.
    """

    def __init__(
        self,
        camera: Camera,
        views: Sequence[SweptKeyframe],
        depth: Callable[[int], Image],
        prior: Callable[[int], PriorImage],
        options: DepthPriorOptions,
    ) -> None:
        self._camera, self._views = camera, views
        self._depth, self._prior, self._options = depth, prior, options
        self._cache: LruCache[Image] = LruCache(2 * _AROUND + 2)

    def depth(self, number: int) -> CompletedDepth:
        """Depth of a keyframe, where it is known or can be inferred."""
        known = self._known(number)
        prior = self._prior(number)
        if self._options.correction.filter:
            prior = without_outliers(prior)
        nothing = CompletedDepth(known, np.zeros(known.shape, bool))
        correction = self._correction(number, known, prior)
        if correction is None:
            return nothing
        filled = correction.apply(prior)
        if not _agrees(filled, known, self._options.max_noise):
            return nothing
        reference = known[known > 0]
        if reference.size:
            near, far = np.percentile(reference, [1.0, 99.0])
            filled[(filled < near / _RANGE) | (filled > far * _RANGE)] = 0.0
        inferred = (known == 0) & (filled > 0)
        return CompletedDepth(np.where(inferred, filled, known), inferred)

    def _correction(self, number: int, known: Image, prior: PriorImage) -> Correction | None:
        """Correction of a prior, None if it does not agree with the known depth."""
        options = self._options.correction
        own = samples_of(prior, known)
        around = [samples_of(prior, self._seen_from(number, n)) for n in self._around(number)]
        samples = Samples.joined([own, *(s.thinned(MAX_SAMPLES // 8) for s in around)])
        whole = fit(samples, prior.kind, options.robust)
        if whole is None or whole.inliers < _MIN_INLIERS:
            return None
        if options.grid < 2:
            return whole
        return fit_grid(samples, whole, options.grid, prior.kind.has_shift)

    def _around(self, number: int) -> list[int]:
        first, last = max(0, number - _AROUND), min(len(self._views) - 1, number + _AROUND)
        return [n for n in range(first, last + 1) if n != number]

    def _known(self, number: int) -> Image:
        return self._cache.get(number, lambda: self._depth(number))

    def _seen_from(self, number: int, other: int) -> Image:
        """Depth [H, W] of another keyframe at the pixels of a keyframe, 0 where it shows none."""
        camera = self._camera
        T_world_number = self._views[number].T_world_camera
        T = se3.inverse(T_world_number) @ self._views[other].T_world_camera
        depth = self._known(other)
        points = se3.transform_points(T, camera.unproject(depth)[depth > 0])
        return splatted(points[points[:, 2] > 0], camera)


def _agrees(corrected: Image, known: Image, max_error: float) -> bool:
    """Whether a corrected prior is close to known depth, and closer than one constant depth."""
    both = (corrected > 0) & (known > 0)
    if not both.any():
        return True
    error = float(np.mean(np.abs(corrected[both] / known[both] - 1.0)))
    flat = float(np.mean(np.abs(np.median(known[both]) / known[both] - 1.0)))
    return error < max_error and error < max(_OF_CONSTANT * flat, _MIN_ERROR)


def splatted(points: NDArray[np.float64], camera: Camera) -> Image:
    """Depth [H, W] of the nearest of some points [P, 3] at each pixel, 0 where there is none."""
    column, row = np.moveaxis(np.rint(camera.project(points)).astype(np.int64), -1, 0)
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    nearest = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(nearest, (row[inside], column[inside]), points[inside, 2])
    return np.where(np.isfinite(nearest), nearest, 0.0).astype(np.float32)
