"""The pose of a frame from features whose points in the map are known.

An edge fixes a feature across its direction only. Each feature is therefore weighted by the
structure tensor of its patch (Foerstner and Guelch, 1987).

If a large object moves, two motions explain the features. Which one is the camera's cannot be seen
in them, so that both are reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import NEAR_M, STUDENT_T_DOF
from toolkit.splatting.alignment.determinacy import UNITS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Standard deviation of the place of a sharp corner in pixels before it is measured, and the bounds
# of the measured one.
SIGMA_PX, _MIN_SIGMA_PX, _MAX_SIGMA_PX = 0.4, 0.25, 1.0
# Standard deviations by which a pose is found if the errors of this share of the features at the
# start exceed them, and limit of the errors.
_SIGMAS_PX, _MOST, _FAR_PX = (10.0 * SIGMA_PX, 2.0 * SIGMA_PX), 0.9, 1e3
_ITERATIONS = 3
_MAX_STEP, _SMALL_STEP = 0.3, 2e-4
# Directions that features hardly determine stay where they are.
_DAMPING = np.diag(1.0 / UNITS**2)
# Standard deviation of the measured direction of an edge.
_DIRECTION_RAD = 0.03
# A feature that misses its place by more follows something else.
_OUTLIER_PX = 2.0
# Fewer features that fit, or a smaller fraction of them, determine no pose.
MIN_FITTING, _MIN_FRACTION = 8, 0.5
# Another motion is looked for if the upper quartile of the errors exceeds this number of pixels and
# neighbouring features have similar errors. It counts if each motion explains this share of the
# features to half a pixel, and both reduce that quartile to this fraction: that of noise falls to
# 0.8.
_NOTICED_PX, _COHERENT, _SECOND, _MUCH_BETTER = 0.3, 0.45, 0.25, 0.5
_EXPLAINED_PX = 0.5
_ROUNDS, _MIN_GROUP, _QUANTILE = 3, 30, 0.75
# Motion of features that keep their place, and parallax of those that should not.
_STILL_PX, _PARALLAX_PX = 0.15, 0.5


@dataclass(frozen=True, eq=False)
class FeaturePose:
    """The pose of a frame that its features determine.

    Attributes:
        T_map_camera: [4, 4].
        information: [6, 6] of x in T_map_camera exp(x), from the measured errors.
        fits: [N] which features fit.
        motions: shares of the features that move in one way and in another one, if each are a
            quarter or more; None otherwise.
    """

    T_map_camera: Array
    information: Array = field(repr=False)
    fits: Mask = field(repr=False)
    motions: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class _Motion:
    """A pose [4, 4] and the errors [N] of features at it in pixels."""

    T_map_camera: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class Observations:
    """Features of a frame with known points.

    Attributes:
        camera: of the frame.
        points: [N, 3] in the map.
        px: [N, 2] where they are in the frame. flow: [N, 2] their motion since the last frame.
        weights: [N, 2, 2] relative information about their places, 1 for sharp corners.
        certain: [N] which points are right; the others tell nothing about the pose in the map.
    """

    camera: Camera
    points: Array
    px: Array
    flow: Array
    weights: Array
    certain: Mask

    def pose(self, starts: Sequence[Array]) -> FeaturePose | None:
        """The pose of the frame; None if too few features fit one.

        Args:
            starts: T_map_camera [4, 4] where the camera may be, from the likeliest to that of the
                last frame.
        """
        if len(self.px) < MIN_FITTING:
            return None
        usual = float(np.quantile(np.minimum(self._errors(starts[0]), _FAR_PX), _MOST))
        one = self._motion(starts[0], [sigma for sigma in _SIGMAS_PX if sigma < usual] + [SIGMA_PX])
        found, motions = self._standing_or_moving(one, starts[-1])
        motions = motions or self._two_motions(one)
        fits = found.errors < _OUTLIER_PX
        count = int(fits.sum())
        if count < max(MIN_FITTING, _MIN_FRACTION * len(fits)):
            return None
        spread = float(np.sqrt(np.mean(found.errors[fits] ** 2) / 2.0))
        sigma = min(max(spread, _MIN_SIGMA_PX), _MAX_SIGMA_PX)
        information = self._of(self.certain)._information(one.T_map_camera)
        information *= (SIGMA_PX / sigma) ** 2
        return FeaturePose(found.T_map_camera, information, fits, motions)

    def _motion(self, T_map_camera: Array, sigmas_px: Sequence[float]) -> _Motion:
        """The pose that minimises the errors under Student's t distribution, by its scales."""
        T = T_map_camera
        for sigma in sigmas_px:
            # Derivatives hardly change with the pose. At a scale, they are those of its start.
            J = self._derivatives(T)
            for _ in range(_ITERATIONS):
                whitened, squares = self._residuals(T)
                robust = (STUDENT_T_DOF + 2) / (STUDENT_T_DOF * sigma**2 + squares)
                weighted = J * np.concatenate([robust, robust])[:, None]
                H, g = J.T @ weighted, whitened.reshape(-1) @ weighted
                step = -np.linalg.solve(H + _DAMPING, g)
                size = float(np.linalg.norm(step))
                T = T @ se3.exp(step * min(1.0, _MAX_STEP / max(size, 1e-9)))
                if size < _SMALL_STEP * sigma / SIGMA_PX:
                    break
        T = se3.orthonormalise(T)
        return _Motion(T, self._errors(T))

    def _information(self, T_map_camera: Array) -> Array:
        """Information [6, 6] at a pose, without what errors in the directions of edges pretend."""
        J, squares = self._derivatives(T_map_camera), self._residuals(T_map_camera)[1]
        robust = (STUDENT_T_DOF + 2) / (STUDENT_T_DOF * SIGMA_PX**2 + np.tile(squares, 2))
        strength = np.trace(self.weights, axis1=1, axis2=2)[:, None, None]
        everywhere = replace(self, weights=strength * np.eye(2))._derivatives(T_map_camera)
        pretended = _DIRECTION_RAD**2 * everywhere.T @ (everywhere * robust[:, None])
        values, axes = np.linalg.eigh(J.T @ (J * robust[:, None]) - pretended)
        return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)

    def _residuals(self, T_map_camera: Array) -> tuple[Array, Array]:
        """Whitened residuals [2, N] and their squares [N]; those behind the camera are infinite."""
        x, y, z = self._local(T_map_camera)
        ahead, camera = z > NEAR_M, self.camera
        z = np.where(ahead, z, 1.0)
        across = camera.fx * (x / z) + (camera.cx - self.px[:, 0])
        down = camera.fy * (y / z) + (camera.cy - self.px[:, 1])
        whitened = self._whitened(across, down)
        return whitened, np.where(ahead, (whitened**2).sum(axis=0), np.inf)

    def _derivatives(self, T_map_camera: Array) -> Array:
        """Derivatives [2 N, 6] of the whitened residuals by x in T_map_camera exp(x)."""
        local = self._local(T_map_camera)
        inverse = 1.0 / np.maximum(local[2], NEAR_M)
        x, y, zero = local[0] * inverse, local[1] * inverse, np.zeros(len(inverse))
        across = np.array([-inverse, zero, x * inverse, x * y, -1.0 - x * x, y])
        down = np.array([zero, -inverse, y * inverse, 1.0 + y * y, -x * y, -x])
        J = self._whitened(self.camera.fx * across, self.camera.fy * down)
        return np.ascontiguousarray(J.transpose(0, 2, 1)).reshape(-1, 6)

    def _local(self, T_map_camera: Array) -> Array:
        """The points [3, N] in the camera's frame."""
        return np.asarray(T_map_camera[:3, :3].T @ (self.points - T_map_camera[:3, 3]).T)

    @cached_property
    def _roots(self) -> tuple[Array, Array, Array]:
        """Elements [N] of the lower triangles whose products with their transposes are weights."""
        xx, xy, yy = self.weights[:, 0, 0], self.weights[:, 0, 1], self.weights[:, 1, 1]
        first = np.sqrt(np.maximum(xx, 1e-12))
        return first, xy / first, np.sqrt(np.maximum(yy - (xy / first) ** 2, 0.0))

    def _whitened(self, across: Array, down: Array) -> Array:
        """Horizontal and vertical values [..., N], times the roots of the weights [2, ..., N]."""
        xx, xy, yy = self._roots
        return np.stack([xx * across + xy * down, yy * down])

    def _errors(self, T_map_camera: Array) -> Array:
        return np.asarray(np.sqrt(self._residuals(T_map_camera)[1]))

    def _of(self, mask: Mask) -> Observations:
        """The features of a mask [N]."""
        points, px, flow = self.points[mask], self.px[mask], self.flow[mask]
        weights, certain = self.weights[mask], self.certain[mask]
        return Observations(self.camera, points, px, flow, weights, certain)

    def _standing_or_moving(
        self, moving: _Motion, T_last: Array
    ) -> tuple[_Motion, tuple[float, float] | None]:
        """The likelier one if the camera may stand still before something that moves, and shares.

        A turn that cancels the translation keeps one plane in place. That many features should keep
        theirs to a fraction of a pixel, while others move, would be a coincidence.

        Args:
            moving: the motion that explains all of them.
            T_last: [4, 4] pose of the last frame.
        """
        still = np.linalg.norm(self.flow, axis=1) < _STILL_PX
        if not _SECOND <= still.mean() <= 1.0 - _SECOND:
            return moving, None
        T_shifted = se3.from_rotation_translation(T_last[:3, :3], moving.T_map_camera[:3, 3])
        places = [projected(self.camera, self.points, T) for T in (T_last, T_shifted)]
        parallax = np.linalg.norm(places[1] - places[0], axis=1)
        share = float((still & (parallax > _PARALLAX_PX)).mean())
        if share < _SECOND:
            return moving, None
        if share < 0.5:
            return moving, (1.0 - share, share)
        return replace(moving, T_map_camera=T_last), (share, 1.0 - share)

    def _two_motions(self, one: _Motion) -> tuple[float, float] | None:
        """The shares of two motions if they explain the features much better than one does.

        Args:
            one: the motion that explains all of them best.
        """
        usual = float(np.quantile(one.errors, _QUANTILE))
        if usual < _NOTICED_PX or not np.isfinite(one.errors).all():
            return None
        residuals = projected(self.camera, self.points, one.T_map_camera) - self.px
        residuals = _limited(residuals)
        if _coherence(self.px, residuals) < _COHERENT:
            return None
        axis = np.linalg.svd(residuals - np.median(residuals, axis=0), full_matrices=False)[2][0]
        along = residuals @ axis
        first, motions = along > np.median(along), [one, one]
        for _ in range(_ROUNDS):
            groups = [first, ~first]
            if min(group.sum() for group in groups) < max(_MIN_GROUP, _SECOND * len(first)):
                return None
            poses = [
                self._of(group)._motion(motion.T_map_camera, (SIGMA_PX,)).T_map_camera
                for group, motion in zip(groups, motions, strict=True)
            ]
            motions = [_Motion(T, self._errors(T)) for T in poses]
            first = motions[0].errors < motions[1].errors
        better = np.minimum(motions[0].errors, motions[1].errors)
        shares = [float((group & (better < _EXPLAINED_PX)).mean()) for group in (first, ~first)]
        if min(shares) < _SECOND or np.quantile(better, _QUANTILE) > _MUCH_BETTER * usual:
            return None
        return max(shares), min(shares)


def projected(camera: Camera, points: Array, T_map_camera: Array) -> Array:
    """Pixels [N, 2] of points [N, 3] of the map; those behind the camera are somewhere outside."""
    local = (points - T_map_camera[:3, 3]) @ T_map_camera[:3, :3]
    local[:, 2] = np.maximum(local[:, 2], NEAR_M)
    return camera.project(local)


def _coherence(px: Array, residuals: Array) -> float:
    """Correlation of the residuals [N, 2] of neighbouring features; that of noise is 0."""
    squares = (px**2).sum(axis=1)
    distances = squares[:, None] + squares - 2.0 * (px @ px.T)
    np.fill_diagonal(distances, np.inf)
    products = float((residuals * residuals[distances.argmin(axis=1)]).sum())
    return products / max(float((residuals**2).sum()), 1e-12)


def _limited(residuals: Array) -> Array:
    """Residuals [N, 2], limited to twice their median length."""
    lengths = np.linalg.norm(residuals, axis=1)
    factors = np.minimum(1.0, 2.0 * np.median(lengths) / np.maximum(lengths, 1e-9))
    return residuals * factors[:, None]
