"""Intrinsics with which depth and colour of a recording agree.

Points of one frame, moved into another one, have its depth and its colour there. With a wrong focal
length, principal point or lens distortion they cannot have both, whatever the motion. So pairs of
frames are aligned together with the intrinsics that they share: focal length, principal point and
one coefficient of radial distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.agreement.pairs import FramePair
from toolkit.datasets.jackknife import jackknife_sigmas
from toolkit.datasets.shutter.alignment import RelativePose
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera

Array = NDArray[np.float64]

# Positions of the unknowns: pose, gain and bias of a pair; intrinsics of all pairs.
_OWN, _SHARED, _UNKNOWNS = slice(0, 8), slice(8, 12), 12
# Parts of the image, without each of which the intrinsics are estimated as well.
_QUARTERS = 4
# Standard deviations of the intrinsics before the images are seen.
_PRIOR = np.array([0.3, 0.1, 0.1, 0.3])
# Maximum difference of corresponding depths, relative. Depths of neighbouring pixels on one surface
# differ by less. Residuals of this many standard deviations have half the weight.
_MAX_DISTANCE, _SURFACE, _HALF_WEIGHT = 0.08, 0.02, 3.0
_MIN_PIXELS, _MIN_PAIRS = 200, 6
_ITERATIONS, _LARGEST_STEP, _CONVERGED = 25, 0.1, 2e-4
# Intrinsics that still change so much after the last iteration are not determined.
_UNSETTLED = 0.01
# Against singular equations, where an image has no texture or shows a single plane.
_RIDGE = 1e-6
# Corrections that are reported: of the focal length (relative), the principal point (in focal
# lengths) and the distortion, and in standard errors. As large corrections of right recordings of
# real sensors have up to 3.7, because registration and noise of depth are not modelled.
_NOTED, _CERTAIN = np.array([0.03, 0.05, 0.05, 0.06]), 5.0
# They must lower the product of the noises of colour and depth by this factor.
_MIN_GAIN = 1.02


@dataclass(frozen=True, eq=False)
class IntrinsicsEstimate:
    """Intrinsics that depth and colour agree with.

    Attributes:
        values: [4] logarithm of the factor of the focal length, offset of the principal point along
            x and y in focal lengths, and coefficient k1 of radial distortion.
        sigmas: [4] their standard deviations, by the estimates without each pair of frames and
            without each quarter of the image: objects that move, and errors of depth, are in parts
            of it.
        gain: factor by which they lower the noise that remains, median over pairs of frames.
    """

    values: Array
    sigmas: Array
    gain: float

    @property
    def noted(self) -> NDArray[np.bool_]:
        """[4] which of the values differ significantly from the stated ones."""
        noted = np.abs(self.values) > np.maximum(_NOTED, _CERTAIN * self.sigmas)
        return noted & (self.gain >= _MIN_GAIN)

    def applied_to(self, camera: Camera) -> Camera:
        """A stated camera of any size with the focal length and principal point found."""
        log_factor, x, y, _ = self.values
        factor = float(np.exp(log_factor))
        return replace(
            camera,
            fx=factor * camera.fx,
            fy=factor * camera.fy,
            cx=camera.cx + float(x) * camera.fx,
            cy=camera.cy + float(y) * camera.fy,
        )

    def finding(self, camera: Camera) -> str | None:
        """A line about stated intrinsics that depth and colour contradict; None if they agree.

        Args:
            camera: the stated one.
        """
        noted, found = self.noted, self.applied_to(camera)
        if not noted.any():
            return None
        words = []
        if noted[0]:
            words.append(f"a focal length of {found.fx:.1f} instead of {camera.fx:.1f}")
        if noted[1] or noted[2]:
            words.append(
                f"a principal point at ({found.cx:.1f}, {found.cy:.1f}) instead of "
                f"({camera.cx:.1f}, {camera.cy:.1f})"
            )
        if noted[3]:
            words.append(f"radial distortion k1 = {self.values[3]:.3f} that is not stated")
        return (
            f"the intrinsics contradict depth and colour, which agree with {' and '.join(words)}; "
            f"calibrate the camera, or use --dataset.intrinsics refine"
        )


def estimate_intrinsics(pairs: Sequence[FramePair]) -> IntrinsicsEstimate | None:
    """Estimate the intrinsics of a recording; None with too few pairs of frames.

    Args:
        pairs: only the farthest of those with the same first frame is used: noise and wrong
            registration of depth weigh least where the motion is large.
    """
    farthest = [_Pair(pair) for pair in {pair.first: pair for pair in pairs}.values()]
    # The second time, the poses start at those of the stated intrinsics.
    stated, found = (_aligned(farthest, free) for free in (False, True))
    if stated is None or found is None:
        return None
    both = stated.noises.keys() & found.noises.keys()
    gains = [stated.noises[first] / found.noises[first] for first in both]
    return IntrinsicsEstimate(found.values, found.sigmas, float(np.median(gains or [0.0])))


@dataclass(frozen=True, eq=False)
class _Aligned:
    """Intrinsics [4] of pairs, their standard deviations [4], and noises by first frames."""

    values: Array
    sigmas: Array
    noises: dict[int, float]


def _aligned(pairs: Sequence[_Pair], free: bool) -> _Aligned | None:
    """Align pairs at the stated intrinsics, or together with free ones.

    Returns:
        None with too few pairs, or if the intrinsics do not converge.
    """
    values, size = np.zeros(4), 0.0
    for _ in range(_ITERATIONS):
        used = [pair for pair in pairs if pair.linearise(values)]
        if len(used) < _MIN_PAIRS:
            return None
        reduced = [pair.reduced() for pair in used]
        H, g = _summed(reduced, values)
        step = np.asarray(np.linalg.solve(H, -g) if free else np.zeros(4), np.float64)
        step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        values = values + step
        moved = max(pair.move(step) for pair in used)
        size = float(np.abs(step).max())
        if max(moved, size) < _CONVERGED:
            break
    if size > _UNSETTLED:  # no intrinsics explain objects that move
        return None
    without = np.array([np.linalg.solve(H - part, -(g - own)) for part, own in reduced])
    quarters = [
        _summed([pair.reduced(without=n) for pair in used], values) for n in range(_QUARTERS)
    ]
    without_quarter = np.array([np.linalg.solve(H, -g) for H, g in quarters])
    sigmas = np.hypot(
        np.sqrt(len(used) / _independent(used)) * jackknife_sigmas(without),
        jackknife_sigmas(without_quarter),
    )
    return _Aligned(values, sigmas, {pair.frames[0]: pair.noise for pair in used})


def _summed(reduced: Sequence[tuple[Array, Array]], values: Array) -> tuple[Array, Array]:
    """Equations [4, 4] and [4] of the intrinsics by all pairs and before the images are seen."""
    H = np.diag(_PRIOR**-2) + sum(part for part, _ in reduced)
    return H, _PRIOR**-2 * values + sum(part for _, part in reduced)


def _independent(pairs: Sequence[_Pair]) -> float:
    """Number of pairs that do not overlap in time; others show nearly the same errors."""
    firsts, seconds = zip(*(pair.frames for pair in pairs), strict=True)
    gap = float(np.median(np.array(seconds) - firsts))
    return min(1.0 + (max(firsts) - min(firsts)) / gap, float(len(pairs)))


class _Pair:
    """Two frames, their relative pose, and the normal equations of that and the intrinsics."""

    def __init__(self, pair: FramePair) -> None:
        self.pose, self.noise, self.frames = pair.pose, 0.0, (pair.first, pair.second)
        self._a, self._b = pair.levels
        camera, points = self._a.camera, self._a.samples
        # Pixels of the samples in focal lengths from the stated principal point.
        self._pixels = points[:, :2] / points[:, 2:]
        self._depths_m = points[:, 2]
        assert camera.size == self._b.camera.size
        right, low = (self._pixels > 0.0).T
        self._quarter = 2 * low + right
        self._H = np.zeros((_QUARTERS, _UNKNOWNS, _UNKNOWNS))
        self._g = np.zeros((_QUARTERS, _UNKNOWNS))

    def linearise(self, values: Array) -> bool:
        """Compute the equations at these intrinsics; False with too few corresponding pixels."""
        a, b, camera = self._a, self._b, self._b.camera
        ray, ray_by_shared = _undistorted(self._pixels, values)
        z = self._depths_m[:, None]
        T = self.pose.T_second_first
        points = np.concatenate([ray * z, z], axis=1) @ T[:3, :3].T + T[:3, 3]
        by_shared = np.einsum("ij,njk->nik", T[:3, :2], ray_by_shared) * z[..., None]
        z = np.maximum(points[:, 2], 1e-3)
        seen = points[:, :2] / z[:, None]
        pixels, by_seen, own_by_shared = _distorted(seen, values)
        u = (camera.fx * pixels[:, 0] + camera.cx).astype(np.float32)[:, None]
        v = (camera.fy * pixels[:, 1] + camera.cy).astype(np.float32)[:, None]
        known = (points[:, 2] > 0) & (u[:, 0] >= 1) & (u[:, 0] < camera.width - 2)
        known &= (v[:, 0] >= 1) & (v[:, 0] < camera.height - 2)
        depth = cv2.remap(b.points[..., 2], u, v, cv2.INTER_LINEAR)[:, 0]
        nearest = cv2.remap(b.points[..., 2], u, v, cv2.INTER_NEAREST)[:, 0]
        normals = cv2.remap(b.normals, u, v, cv2.INTER_NEAREST)[:, 0].astype(np.float64)
        known &= (nearest > 0) & (np.abs(depth - nearest) < _SURFACE * nearest)
        known &= (normals[:, 2] != 0) & (np.abs(depth - z) < _MAX_DISTANCE * z)
        if known.sum() < _MIN_PIXELS:
            return False
        # Derivatives of the point in the second camera, and of the pixel where it is seen.
        by_own = np.zeros((len(points), 3, 8))
        by_own[:, :, :3] = np.eye(3)
        by_own[:, :, 3:6] = -_hats(points)
        point_by = np.concatenate([by_own, by_shared], axis=2)
        seen_by = (point_by[:, :2] - seen[..., None] * point_by[:, 2:]) / z[:, None, None]
        pixel_by = np.einsum("nij,njk->nik", by_seen, seen_by)
        pixel_by[:, :, _SHARED] += own_by_shared
        focal = np.array([camera.fx, camera.fy])
        intensity = cv2.remap(b.intensity, u, v, cv2.INTER_LINEAR)[:, 0].astype(np.float64)
        slope = cv2.remap(b.gradients, u, v, cv2.INTER_LINEAR)[:, 0] * focal
        gain, bias = self.pose.exposure
        colour = (1.0 + gain) * intensity + bias - a.sample_intensity
        J_colour = (1.0 + gain) * np.einsum("ni,nik->nk", slope, pixel_by)
        J_colour[:, 6], J_colour[:, 7] = intensity, 1.0
        # Distance along the ray from the tangent plane, whose depth changes with the pixel, in
        # units of the sensor's noise at a depth of 1 m.
        weight = np.abs(normals[:, 2]) / z**2
        normals = np.where(known[:, None], normals, (0.0, 0.0, 1.0))
        tilt = normals[:, :2] / normals[:, 2:]
        depth_slope = -tilt * (depth / (1.0 + (tilt * seen).sum(axis=1)))[:, None]
        surface = (z - depth) * weight
        J_surface = point_by[:, 2] - np.einsum("ni,nik->nk", depth_slope, pixel_by)
        J_surface *= weight[:, None]
        self._H[:], self._g[:] = _RIDGE / _QUARTERS * np.eye(_UNKNOWNS), 0.0
        self.noise = 1.0
        quarters = [self._quarter[known] == n for n in range(_QUARTERS)]
        for r, J in ((colour[known], J_colour[known]), (surface[known], J_surface[known])):
            sigma = 1.4826 * float(np.median(np.abs(r))) + 1e-6
            self.noise *= sigma
            weighted = J / (sigma**2 * (1.0 + (r / (_HALF_WEIGHT * sigma)) ** 2))[:, None]
            for n, quarter in enumerate(quarters):
                self._H[n] += J[quarter].T @ weighted[quarter]
                self._g[n] += weighted[quarter].T @ r[quarter]
        return True

    def reduced(self, without: int | None = None) -> tuple[Array, Array]:
        """Equations [4, 4] and [4] of the intrinsics, pose and exposure eliminated.

        Args:
            without: number of a quarter of the image that is left out.
        """
        used = [n for n in range(_QUARTERS) if n != without]
        H, g = self._H[used].sum(axis=0), self._g[used].sum(axis=0)
        known = np.column_stack([H[_OWN, _SHARED], g[_OWN]])
        eliminated = H[_SHARED, _OWN] @ np.linalg.solve(H[_OWN, _OWN], known)
        return H[_SHARED, _SHARED] - eliminated[:, :4], g[_SHARED] - eliminated[:, 4]

    def move(self, step: Array) -> float:
        """Update pose and exposure after a step [4] of the intrinsics.

        Returns:
            The largest change of an unknown.
        """
        H, g = self._H.sum(axis=0), self._g.sum(axis=0)
        wanted = -(g[_OWN] + H[_OWN, _SHARED] @ step)
        own = np.asarray(np.linalg.solve(H[_OWN, _OWN], wanted), np.float64)
        T = se3.orthonormalise(se3.exp(own[:6]) @ self.pose.T_second_first)
        self.pose = RelativePose(T, self.pose.exposure + own[6:])
        return float(np.abs(own).max())


def _distorted(seen: Array, values: Array) -> tuple[Array, Array, Array]:
    """Pixels [N, 2] in stated focal lengths, of points [N, 2] on the plane at depth 1.

    Returns:
        Also their derivatives by the points [N, 2, 2] and by the intrinsics [N, 2, 4].
    """
    scale, k1 = np.exp(values[0]), values[3]
    squared = (seen**2).sum(axis=1)[:, None]
    bent = scale * (1.0 + k1 * squared) * seen
    by_seen = scale * (1.0 + k1 * squared)[..., None] * np.eye(2)
    by_seen = by_seen + 2.0 * scale * k1 * seen[:, :, None] * seen[:, None, :]
    by_values = np.zeros((len(seen), 2, 4))
    by_values[:, :, 0] = bent
    by_values[:, 0, 1] = by_values[:, 1, 2] = 1.0
    by_values[:, :, 3] = scale * squared * seen
    return bent + values[1:3], by_seen, by_values


def _undistorted(pixels: Array, values: Array) -> tuple[Array, Array]:
    """Points [N, 2] of pixels [N, 2], see `_distorted`, and derivatives [N, 2, 4]."""
    bent = (pixels - values[1:3]) / np.exp(values[0])
    seen = bent
    for _ in range(4):
        seen = bent / (1.0 + values[3] * (seen**2).sum(axis=1)[:, None])
    _, by_seen, by_values = _distorted(seen, values)
    return seen, -np.asarray(np.linalg.solve(by_seen, by_values), np.float64)


def _hats(points: Array) -> Array:
    """Matrices [N, 3, 3] of the cross products with points [N, 3]."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), 2, 0)
