"""Landmarks: corners with measured depth, followed from frame to frame.

A second source of evidence for the pose of a frame, beside its alignment to the map. The images
show thin joints and small marks that the map blurs, and a corner is found again wherever it moves
within its neighbourhood, while dense alignment needs a motion of less than the texture's size.

An edge fixes a feature across its direction only. Each feature is therefore weighted by the
structure tensor of its patch (Foerstner, 1987), by which Lucas and Kanade's method finds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from toolkit.alignment.data import FrameLevel
from toolkit.alignment.determinacy import UNITS
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.features.tracks import Features, FeatureTracks
from toolkit.native.constants import STUDENT_T_DOF

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Features per image, and fraction of them below which new ones are found.
_COUNT, _MIN_KEPT = 200, 0.8
# Eigenvalue of the structure tensor at which a direction has half the weight of a sharp corner.
_EDGE = 0.005
_BLOCK = 9
# Quantile of the smaller eigenvalues of an image that noise causes, as long as they are this small,
# and how far a direction must exceed it.
_BLANK, _MAX_BLANK, _NOISE = 0.1, 2e-4, 4.0
# Pixels around a feature whose depths must agree, as a fraction of depth.
_SAME_SURFACE = 0.08
# Standard deviation of a feature's place in pixels before it is measured, and bounds of that.
_SIGMA_PX, _MIN_SIGMA_PX, _MAX_SIGMA_PX = 0.4, 0.25, 1.0
# Scales at which the pose is found, relative to the last one: predictions may be wrong by pixels.
_SCALES = (10.0, 3.0, 1.0)
_ITERATIONS = 4
# Features beyond this number of standard deviations follow something else.
_OUTLIER = 5.0
# Another motion is looked for if the upper quartile of the errors exceeds this number of pixels, and
# neighbouring features have similar ones. It counts if each moves this share of the features, and
# both together reduce that quartile to this fraction. Two motions reduce that of noise to 0.8.
_NOTICED_PX, _COHERENT, _SECOND, _MUCH_BETTER = 0.3, 0.45, 0.25, 0.5
_ROUNDS, _MIN_GROUP, _QUANTILE = 3, 16, 0.75
# Motion of features that keep their place, and parallax of those that should not.
_STILL_PX, _PARALLAX_PX = 0.15, 0.5
# Fewer features that fit, or a smaller fraction of them, determine no pose.
_MIN_FITTING, _MIN_FRACTION = 8, 0.5
_NEAR_M = 0.05
# Directions that features hardly determine stay where they are.
_DAMPING = np.diag(1.0 / UNITS**2)
_MAX_STEP, _SMALL_STEP = 0.3, 1e-5


@dataclass(frozen=True, eq=False)
class FeaturePose:
    """The pose of a frame that its features determine.

    Attributes:
        T_map_camera: [4, 4].
        information: [6, 6] of x in T_map_camera exp(x), from the measured errors of the features.
        fitting: number of features that fit.
        sigma_px: standard deviation of a feature's place.
        motions: shares of the features that move with this pose and with another one, if a quarter
            or more do that; None otherwise.
    """

    T_map_camera: Array
    information: Array = field(repr=False)
    fitting: int
    sigma_px: float
    motions: tuple[float, float] | None = None


def grey_image(intensity: Tensor) -> Image:
    """An image [H, W] of bytes of intensities in [0, 1]."""
    return (255.0 * intensity.cpu().numpy() + 0.5).clip(0, 255).astype(np.uint8)


class Landmarks:
    """Follows features whose positions in the map are known."""

    def __init__(self, count: int = _COUNT) -> None:
        self._count = count
        self._tracks = FeatureTracks(count)
        self._ids = np.zeros(0, np.int64)
        self._points = np.zeros((0, 3))
        self._weights = np.zeros((0, 2, 2))
        self._unsettled = 0
        self._before: tuple[Image, Features] | None = None

    def locate(self, frame: FrameLevel, starts: Sequence[Array]) -> FeaturePose | None:
        """Follow the features into the next image [H, W], and find its pose.

        Args:
            starts: T_map_camera [4, 4] where the camera may be, the likeliest first.
        """
        if not len(self._tracks.features):
            return None
        image, camera = grey_image(frame.intensity), frame.camera
        before = self._tracks.features
        self._before = self._tracks.image, before
        known = self._row(self._tracks.features)
        guesses = [_projected(camera, self._points[known], T) for T in starts]
        features = self._tracks.follow(image, guesses)
        known = self._row(features)
        points, weights = self._points[known], self._weights[known]
        if len(points) < _MIN_FITTING:
            return None
        seen = _Seen(camera, points, features.px, weights)
        found = seen.solved(starts[0], *(scale * _SIGMA_PX for scale in _SCALES))
        flow = features.px - before.px[np.searchsorted(before.ids, features.ids)]
        found, motions = seen.standing_or_moving(found, flow, starts[-1]) or seen.two_motions(found)
        fits = found.errors < _OUTLIER * _SIGMA_PX
        self._tracks.keep(fits)
        count = int(fits.sum())
        if count < _MIN_FITTING or count < _MIN_FRACTION * len(fits):
            return None
        spread = float(np.sqrt(np.mean(found.errors[fits] ** 2) / 2))
        sigma = min(max(spread, _MIN_SIGMA_PX), _MAX_SIGMA_PX)
        information = found.information * (found.sigma / sigma) ** 2
        return FeaturePose(found.T_map_camera, information, count, sigma, motions)

    def extend(self, frame: FrameLevel) -> None:
        """Find new features in the image that was located last, if many were lost.

        Their positions are known once its pose is (`settle`).
        """
        image, depth_m, camera = grey_image(frame.intensity), frame.depth_m.cpu().numpy(), frame.camera
        if not len(self._tracks.features):
            self._tracks.continue_from(image, self._tracks.features)
        if len(self._tracks.features) > _MIN_KEPT * self._count:
            return
        before = len(self._tracks.features)
        features = self._tracks.replenish()
        new = Features(features.ids[before:], features.px[before:])
        depth = _depths(depth_m, new.px)
        measured = depth > 0
        self._tracks.keep(np.concatenate([np.ones(before, bool), measured]))
        new, depth = new.select(measured), depth[measured]
        rays = np.column_stack([(new.px - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(new))])
        kept = self._row(Features(features.ids[:before], features.px[:before]))
        self._ids = np.concatenate([self._ids[kept], new.ids])
        self._points = np.concatenate([self._points[kept], rays * depth[:, None]])
        self._unsettled = len(new)
        self._weights = np.concatenate([self._weights[kept], _structure(image, new.px)])

    def settle(self, T_map_camera: Array) -> None:
        """Give the newest features, if there are any, the pose [4, 4] of the image they are from."""
        if self._unsettled:
            first = len(self._points) - self._unsettled
            self._points[first:] = se3.transform_points(T_map_camera, self._points[first:])
            self._unsettled = 0

    def undo(self) -> None:
        """Forget the image that was located last: the next one is compared with that before."""
        if self._before is not None:
            self._tracks.continue_from(*self._before)

    def change_frame(self, T_new_old: Array) -> None:
        """Change the coordinate frame of the map."""
        settled = len(self._points) - self._unsettled
        self._points[:settled] = se3.transform_points(T_new_old, self._points[:settled])

    def _row(self, features: Features) -> NDArray[np.intp]:
        return np.searchsorted(self._ids, features.ids)


@dataclass(frozen=True, eq=False)
class _Solution:
    """A pose and how features fit it: see `FeaturePose`; weighted errors [N] in pixels."""

    T_map_camera: Array
    errors: Array
    information: Array
    sigma: float


@dataclass(frozen=True, eq=False)
class _Seen:
    """Features with known points [N, 3], followed to pixels [N, 2]; weights [N, 2, 2] of these."""

    camera: Camera
    points: Array
    px: Array
    weights: Array

    def solved(self, T_map_camera: Array, *sigmas: float) -> _Solution:
        """The pose that minimises the errors under Student's t distribution, by its scales."""
        T = T_map_camera
        for sigma in sigmas:
            for _ in range(_ITERATIONS):
                local, errors, weighted, weight = self._residuals(T, sigma)
                J = _jacobians(self.camera, local)
                WJ = np.einsum("nij,njk->nik", self.weights, J) * weight[:, None, None]
                H = np.tensordot(J, WJ, axes=([0, 1], [0, 1]))
                g = np.einsum("nik,ni,n->k", J, weighted, weight)
                step = -np.linalg.solve(H + _DAMPING, g)
                size = float(np.linalg.norm(step))
                T = se3.orthonormalise(T @ se3.exp(step * min(1.0, _MAX_STEP / max(size, 1e-9))))
                if size < _SMALL_STEP:
                    break
        return _Solution(T, self._residuals(T, sigma)[1], H, sigma)

    def _residuals(self, T: Array, sigma: float) -> tuple[Array, Array, Array, Array]:
        """Local points [N, 3], errors [N], weighted residuals [N, 2] and robust weights [N]."""
        local = (self.points - T[:3, 3]) @ T[:3, :3]
        ahead = local[:, 2] > _NEAR_M
        local = np.where(ahead[:, None], local, [0.0, 0.0, 1.0])
        residuals = self.camera.project(local) - self.px
        weighted = np.einsum("nij,nj->ni", self.weights, residuals)
        squares = np.where(ahead, (residuals * weighted).sum(1), np.inf)
        robust = (STUDENT_T_DOF + 2) / (STUDENT_T_DOF * sigma**2 + squares)
        return local, np.sqrt(squares), weighted, robust

    def of(self, mask: NDArray[np.bool_]) -> _Seen:
        """The features of a mask [N]."""
        return _Seen(self.camera, self.points[mask], self.px[mask], self.weights[mask])

    def standing_or_moving(
        self, moving: _Solution, flow: Array, T_last: Array
    ) -> tuple[_Solution, tuple[float, float]] | None:
        """The likelier one if the camera may stand still before something that moves, and shares.

        A turn that cancels the translation keeps one plane in place. That many features should keep
        theirs to a fraction of a pixel, while others move, would be a coincidence.

        Args:
            moving: the motion that explains all of them.
            flow: [N, 2] motion of the features since the last image. T_last: [4, 4] its pose.
        """
        T_shifted = se3.from_rotation_translation(T_last[:3, :3], moving.T_map_camera[:3, 3])
        shifts = [_projected(self.camera, self.points, T) for T in (T_last, T_shifted)]
        parallax = np.linalg.norm(shifts[1] - shifts[0], axis=1)
        still = np.linalg.norm(flow, axis=1) < _STILL_PX
        share = float((still & (parallax > _PARALLAX_PX)).mean())
        if share < _SECOND or 1.0 - float(still.mean()) < _SECOND:
            return None
        if share < 0.5:
            return moving, (1.0 - share, share)
        return replace(moving, T_map_camera=T_last), (share, 1.0 - share)

    def two_motions(self, one: _Solution) -> tuple[_Solution, tuple[float, float] | None]:
        """The motion of most features and the shares of two, if two explain them much better.

        Args:
            one: the motion that explains all of them best.
        """
        local = self._residuals(one.T_map_camera, 1.0)[0]
        residuals = self.camera.project(local) - self.px
        usual = float(np.quantile(one.errors, _QUANTILE))
        if usual < _NOTICED_PX or _coherence(self.px, residuals) < _COHERENT:
            return one, None
        centred = residuals - np.median(residuals, axis=0)
        axis = np.linalg.eigh(centred.T @ (centred * _limited(centred)[:, None]))[1][:, -1]
        first, motions = centred @ axis > 0, [one, one]
        for _ in range(_ROUNDS):
            groups = [first, ~first]
            if min(group.sum() for group in groups) < max(_MIN_GROUP, _SECOND * len(first)):
                return one, None
            poses = [
                self.of(group).solved(motion.T_map_camera, _SIGMA_PX).T_map_camera
                for group, motion in zip(groups, motions, strict=True)
            ]
            motions = [replace(one, T_map_camera=T, errors=self._residuals(T, 1.0)[1]) for T in poses]
            first = motions[0].errors < motions[1].errors
        better = np.minimum(motions[0].errors, motions[1].errors)
        if np.quantile(better, _QUANTILE) > _MUCH_BETTER * usual:
            return one, None
        shares = float(first.mean()), float(1.0 - first.mean())
        larger = int(shares[1] > shares[0])
        return motions[larger], (shares[larger], shares[1 - larger])


def _coherence(px: Array, residuals: Array) -> float:
    """Correlation of the residuals [N, 2] of neighbouring features at [N, 2]; that of noise is 0."""
    _, near = cKDTree(px).query(px, 2)
    limited = residuals * _limited(residuals)[:, None]
    return float((limited * limited[near[:, 1]]).sum() / max((limited**2).sum(), 1e-12))


def _limited(residuals: Array) -> Array:
    """Factors [N] that limit residuals [N, 2] to twice the median length."""
    lengths = np.linalg.norm(residuals, axis=1)
    return np.minimum(1.0, 2.0 * np.median(lengths) / np.maximum(lengths, 1e-9))


def _jacobians(camera: Camera, local: Array) -> Array:
    """Derivatives [N, 2, 6] of the pixels of points [N, 3] by x in T_map_camera exp(x)."""
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    zero, inverse = np.zeros(len(local)), 1.0 / local[:, 2]
    across = np.stack([-inverse, zero, x * inverse, x * y, -1.0 - x * x, y], 1)
    down = np.stack([zero, -inverse, y * inverse, 1.0 + y * y, -x * y, -x], 1)
    return np.stack([camera.fx * across, camera.fy * down], 1)


def _projected(camera: Camera, points: Array, T_map_camera: Array) -> Array:
    local = (points - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    local[:, 2] = np.maximum(local[:, 2], _NEAR_M)
    return camera.project(local)


def _depths(depth_m: NDArray[np.float32], px: Array) -> Array:
    """Depths [N] at pixels [N, 2] (m), 0 where they are missing or belong to an edge."""
    column, row = np.rint(px).astype(int).T
    around = np.stack([depth_m[row + j, column + i] for j in (-1, 0, 1) for i in (-1, 0, 1)])
    low, high = around.min(axis=0), around.max(axis=0)
    good = (low > 0) & (high - low < _SAME_SURFACE * low)
    return np.where(good, around[4], 0.0).astype(np.float64)


def _structure(image: Image, px: Array) -> Array:
    """Relative information [N, 2, 2] about the places of features, 1 across sharp edges."""
    found = cv2.cornerEigenValsAndVecs(image, _BLOCK, 3)
    blank = float(np.quantile(found[::_BLOCK, ::_BLOCK, :2].min(axis=-1), _BLANK))
    noise = _NOISE * min(blank, _MAX_BLANK)
    column, row = np.rint(px).astype(int).T
    values = found[row, column].astype(np.float64)
    directions = values[:, 2:].reshape(-1, 2, 2)
    signal = np.maximum(values[:, :2] - noise, 0.0)
    known = signal / (signal + _EDGE)
    return np.einsum("nki,nk,nkj->nij", directions, known, directions)
