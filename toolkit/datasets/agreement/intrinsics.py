"""Intrinsics with which depth and colour of a recording agree.

Points of one frame, moved into another one, have its depth and its colour there. With a wrong focal
length, principal point or lens distortion they cannot have both, whatever the motion. So pairs of
frames are aligned together with the intrinsics that they share: focal length, principal point and
one coefficient of radial distortion.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.agreement.lens import derivatives, distorted, undistorted
from toolkit.datasets.agreement.pairs import FramePair
from toolkit.datasets.jackknife import jackknife_sigmas
from toolkit.datasets.shutter.alignment import RelativePose

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
        gain: factor by which they lower the noise that remains, median over pairs of frames; it is
            not computed for values that would not be noted.
    """

    values: Array
    sigmas: Array
    gain: float = float("inf")

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
    farthest = {pair.first: pair for pair in pairs}.values()
    found = _aligned(farthest, free=True)
    if found is None:
        return None
    estimate = IntrinsicsEstimate(found.values, found.sigmas)
    if not estimate.noted.any():
        return estimate
    stated = _aligned(farthest, free=False)
    if stated is None:
        return None
    both = stated.noises.keys() & found.noises.keys()
    gains = [stated.noises[first] / found.noises[first] for first in both]
    return replace(estimate, gain=float(np.median(gains or [0.0])))


@dataclass(frozen=True, eq=False)
class _Aligned:
    """Intrinsics [4] of pairs, their standard deviations [4], and noises by first frames."""

    values: Array
    sigmas: Array
    noises: dict[int, float]


def _aligned(frames: Iterable[FramePair], free: bool) -> _Aligned | None:
    """Align pairs of frames at the stated intrinsics, or together with free ones.

    Returns:
        None with too few pairs, or if the intrinsics do not converge.
    """
    pairs = [_Pair(pair) for pair in frames]
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
        first, second = pair.levels
        assert first.camera.size == second.camera.size
        self._camera = second.camera
        # Pixels of the samples in focal lengths from the stated principal point, by quarters.
        x, y = (first.samples[:, :2] / first.samples[:, 2:]).T
        quarter = 2 * (y > 0.0) + (x > 0.0)
        order = np.argsort(quarter, kind="stable")
        self._pixels = np.stack([x, y])[:, order]
        self._depths_m = first.samples[order, 2]
        self._intensity, self._quarter = first.sample_intensity[order], quarter[order]
        depth_m = second.points[..., 2:]
        # The second frame: intensity, its slope and depth; depth and normals.
        self._smooth = np.concatenate(
            [second.intensity[..., None], second.gradients, depth_m], axis=-1
        )
        self._surface = np.concatenate([depth_m, second.normals], axis=-1)
        self._H = np.zeros((_QUARTERS, _UNKNOWNS, _UNKNOWNS))
        self._g = np.zeros((_QUARTERS, _UNKNOWNS))

    def linearise(self, values: Array) -> bool:
        """Compute the equations at these intrinsics; False with too few corresponding pixels."""
        camera, T = self._camera, self.pose.T_second_first
        rays = undistorted(self._pixels, values)
        points = (T[:3, :2] @ rays + T[:3, 2:3]) * self._depths_m + T[:3, 3:]
        z = np.maximum(points[2], 1e-3)
        pixels = distorted(points[:2] / z, values)
        u = (camera.fx * pixels[0] + camera.cx).astype(np.float32)
        v = (camera.fy * pixels[1] + camera.cy).astype(np.float32)
        depth, *normal = _remapped(self._surface, u, v, cv2.INTER_NEAREST)
        intensity, slope_u, slope_v, between = _remapped(self._smooth, u, v, cv2.INTER_LINEAR)
        known = (points[2] > 0) & (u >= 1) & (u < camera.width - 2)
        known &= (v >= 1) & (v < camera.height - 2)
        known &= (depth > 0) & (np.abs(between - depth) < _SURFACE * depth)
        known &= (normal[2] != 0) & (np.abs(between - z) < _MAX_DISTANCE * z)
        if known.sum() < _MIN_PIXELS:
            return False
        by_rays = T[:3, :2, None] * self._depths_m[known]
        seen = rays[:, known], points[:, known], by_rays, values
        gain, bias = self.pose.exposure
        intensity = intensity[known]
        slope = (1.0 + gain) * np.stack([camera.fx * slope_u[known], camera.fy * slope_v[known]])
        colour = (1.0 + gain) * intensity + bias - self._intensity[known]
        J_colour = derivatives(*seen, slope, 0.0)
        J_colour[6], J_colour[7] = intensity, 1.0
        # Distance along the ray from the tangent plane, whose depth changes with the pixel, in
        # units of the sensor's noise at a depth of 1 m.
        x, y, z = points[:, known]
        n_x, n_y, n_z = (component[known] for component in normal)
        weight, depth = np.abs(n_z) / z**2, between[known]
        tilt = np.stack([n_x, n_y]) / n_z
        tilt *= depth / (1.0 + (tilt[0] * x + tilt[1] * y) / z)
        J_surface = weight * derivatives(*seen, tilt, 1.0)
        self._accumulate(known, ((colour, J_colour), ((z - depth) * weight, J_surface)))
        return True

    def _accumulate(
        self, known: NDArray[np.bool_], residuals: Sequence[tuple[Array, Array]]
    ) -> None:
        """Set the equations of the quarters from residuals [M] and their derivatives [12, M]."""
        self._H[:], self._g[:] = _RIDGE / _QUARTERS * np.eye(_UNKNOWNS), 0.0
        self.noise = 1.0
        ends = np.searchsorted(self._quarter[known], np.arange(_QUARTERS + 1))
        for r, J in residuals:
            sigma = 1.4826 * float(np.median(np.abs(r))) + 1e-6
            self.noise *= sigma
            weighted = J / (sigma**2 * (1.0 + (r / (_HALF_WEIGHT * sigma)) ** 2))
            for n in range(_QUARTERS):
                own = slice(ends[n], ends[n + 1])
                self._H[n] += J[:, own] @ weighted[:, own].T
                self._g[n] += weighted[:, own] @ r[own]

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


def _remapped(image: NDArray[np.float32], u: Array, v: Array, method: int) -> Array:
    """Values [C, N] of an image [H, W, C] at pixels [N]."""
    return np.asarray(cv2.remap(image, u[None], v[None], method)[0].T, np.float64)
