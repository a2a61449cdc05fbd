"""Takes the noise out of depth, as much as there is, before it is tracked and mapped.

A plane is linear in inverse depth, and the noise of cameras that triangulate is even in it. So
each pixel takes its place on the plane through the largest window about it that is a plane to
within the noise: of 289 pixels on a wall, six in a hundred of the noise are left. Where no
window is one, like neighbours are averaged.

Noise is not harmless to a map: of overlapping Gaussians the nearer one hides the other, so a
noisy surface is drawn too near and walls become thick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.frame import Frame
from toolkit.native import address, kernels_for
from toolkit.native.constants import MIN_PLANE_DETERMINANT

# Half-sizes of the windows.
_RADII = (8, 5, 3, 2)
# A window is a plane where its variance exceeds the noise's by no more than chance does: so
# many standard deviations of an estimate of it.
_SLACK = 1.5
_LEAST_SHARE = 0.6
# A step of this many standard deviations is an edge.
_EDGE_SIGMAS = 6.0
_REACH = 3
# Noise below this is quantisation (1 / m): leave exact depth as it is.
_LEAST_NOISE = 2e-4
# On which the noise is estimated: as measured, halved and halved again.
_LEVELS = 3


class DepthFilter:
    """Smooths the frames of a sequence; another thread may do so ahead of their turn."""

    def __init__(self) -> None:
        self._ahead: dict[int, tuple[Frame, Frame]] = {}

    def prepare(self, frame: Frame) -> Frame:
        """A frame without noise, kept until it is asked for."""
        smooth = replace(frame, depth_m=denoised(frame.depth_m))
        self._ahead[frame.index] = frame, smooth
        return smooth

    def of(self, frame: Frame) -> Frame:
        """A frame without noise, made before or now."""
        given, smooth = self._ahead.pop(frame.index, (None, None))
        if smooth is not None and given is frame:
            return smooth
        return replace(frame, depth_m=denoised(frame.depth_m))


@dataclass(frozen=True)
class _Window:
    """Sums over the window about each pixel."""

    radius: int

    def sum(self, image: NDArray[np.float64], u: int = 0, v: int = 0) -> NDArray[np.float64]:
        """Sum of u^a v^b times the image, u to the right and v down from the middle."""
        steps = np.arange(-self.radius, self.radius + 1, dtype=np.float64)
        return cv2.sepFilter2D(
            image, cv2.CV_64F, steps**u, steps**v, borderType=cv2.BORDER_CONSTANT
        )


def inverse_depth_noise(depth_m: NDArray[np.float32]) -> float:
    """Robust standard deviation (1 / m) of the noise in inverse depth.

    Second differences of a plane are noise alone. Between neighbours they miss what is alike in
    neighbours: the steps of a sensor that rounds, blotches of one that matches patches. Means
    over 2x2 and 4x4 pixels show those, and white noise less; the largest answer counts.
    """
    inverse = _inverse(depth_m[_sampled_rows(len(depth_m))])
    noise = 0.0
    for _ in range(_LEVELS):
        noise = max(noise, _noise_between_neighbours(inverse))
        inverse = _halved(inverse)
    return noise


def _sampled_rows(height: int) -> NDArray[np.int64]:
    """Rows in groups that can be halved, a third of all."""
    group = 2 ** (_LEVELS - 1)
    starts = np.arange(0, height - group + 1, 3 * group)
    return (starts[:, None] + np.arange(group)).reshape(-1)


def _inverse(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    valid = depth_m > 0
    return np.where(valid, 1.0 / np.where(valid, depth_m, 1.0), 0.0).astype(np.float32)


def _halved(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over 2x2 pixels, where all four are measured."""
    height, width = (size // 2 * 2 for size in inverse.shape)
    parts = [inverse[i:height:2, j:width:2] for i in (0, 1) for j in (0, 1)]
    known = np.min(parts, axis=0) > 0
    return np.where(known, np.mean(parts, axis=0), 0.0).astype(np.float32)


def _noise_between_neighbours(inverse: NDArray[np.float32]) -> float:
    left, centre, right = inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:]
    second = np.abs(left - 2.0 * centre + right)[(left > 0) & (centre > 0) & (right > 0)]
    # Median absolute value of a normal variable of variance 1 + 4 + 1.
    return float(np.median(second) / (0.6745 * np.sqrt(6.0))) if second.size else 0.0


def denoised(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] (m, 0 missing) without its noise.

    Missing pixels stay missing; depth without noise comes back unchanged.
    """
    noise = inverse_depth_noise(depth_m)
    if noise < _LEAST_NOISE:
        return depth_m
    return _inverse(_smoothed(_inverse(depth_m), noise))


def _smoothed(inverse: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    given = torch.from_numpy(inverse)
    module = kernels_for(given)
    if module is None:
        return _smoothed_numpy(inverse, noise)
    out = torch.empty(inverse.shape)
    module.smooth_inverse_depth(
        inverse.shape[::-1],
        address(given),
        _RADII,
        _REACH,
        (noise, _SLACK, _LEAST_SHARE, _EDGE_SIGMAS * noise),
        address(out),
    )
    return out.numpy()


def _smoothed_numpy(inverse: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    """What the native kernel does, where none was built."""
    d = inverse.astype(np.float64)
    measured = inverse > 0
    smooth = np.zeros_like(d)
    for radius in _RADII:
        planes = _planes(d, measured.astype(np.float64), _Window(radius), noise)
        smooth = np.where(measured & (smooth == 0), planes, smooth)
    left = measured & ~(smooth > 0)
    return np.where(left, _mean_of_like(d, noise), smooth).astype(np.float32)


def _planes(
    d: NDArray[np.float64], one: NDArray[np.float64], window: _Window, noise: float
) -> NDArray[np.float64]:
    """Value [H, W] at the middle of the plane through each window, 0 where it is none."""
    n = window.sum(one)
    count = np.maximum(n, 1.0)
    u, v = window.sum(one, u=1) / count, window.sum(one, v=1) / count
    mean = window.sum(d) / count
    uu = window.sum(one, u=2) - n * u * u
    uv = window.sum(one, u=1, v=1) - n * u * v
    vv = window.sum(one, v=2) - n * v * v
    ud = window.sum(d, u=1) - n * u * mean
    vd = window.sum(d, v=1) - n * v * mean
    dd = window.sum(d * d) - n * mean * mean
    determinant = uu * vv - uv * uv
    good = n >= _LEAST_SHARE * (2 * window.radius + 1) ** 2
    good &= determinant > MIN_PLANE_DETERMINANT * uu * vv
    determinant = np.where(good, determinant, 1.0)
    across = (ud * vv - vd * uv) / determinant
    down = (vd * uu - ud * uv) / determinant
    free = np.where(good, n - 3.0, 1.0)
    variance = (dd - across * ud - down * vd) / free
    good &= variance <= noise**2 * (1.0 + _SLACK * np.sqrt(2.0 / free))
    return np.where(good, mean - across * u - down * v, 0.0)


def _mean_of_like(d: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """Mean [H, W] of the neighbours across no edge, near and alike ones counting more."""
    wide = np.pad(d, _REACH)
    height, width = d.shape
    total, weights = np.zeros_like(d), np.full_like(d, 1e-12)
    for j in range(2 * _REACH + 1):
        for i in range(2 * _REACH + 1):
            other = wide[j : j + height, i : i + width]
            far = ((i - _REACH) ** 2 + (j - _REACH) ** 2) / (_REACH + 1) ** 2
            like = np.maximum(1.0 - ((other - d) / (_EDGE_SIGMAS * noise)) ** 2, 0.0)
            weight = max(1.0 - far, 0.0) * like**2 * (other > 0)
            total += weight * (other - d)
            weights += weight
    return d + total / weights
