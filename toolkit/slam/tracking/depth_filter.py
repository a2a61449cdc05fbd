"""Depth filter: removes sensor noise from depth images before tracking and mapping.

A plane is linear in inverse depth, and the noise of triangulating cameras is uniform in inverse
depth. Therefore each pixel is replaced by the value of a plane fitted to the largest window around
it that is planar within the noise. On a wall, a window of 289 pixels reduces the noise to 6 %.
If no window is planar, the pixel is replaced by a bilateral average of its neighbours.

Noise biases a map: the nearer one of overlapping Gaussians hides the others, so that a noisy
surface is rendered too near and walls become thick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.native import address, kernels, kernels_for
from toolkit.base.native.constants import MIN_PLANE_DETERMINANT
from toolkit.slam.tracking.flying_pixels import without_flying_pixels

# Maximum difference of the inverse depths on both sides of a gap, relative to their mean.
_MAX_DIFFERENCE = 0.05
# Half-sizes of the windows.
_RADII = (8, 5, 3, 2)
# A window is planar if its variance exceeds that of the noise by at most this number of standard
# deviations of the variance estimate.
_MAX_EXCESS_SIGMAS = 1.5
# Minimum fraction of measured pixels in a window.
_MIN_VALID_FRACTION = 0.6
# Minimum depth step of an edge, in standard deviations of the noise.
_EDGE_SIGMAS = 6.0
# Half-size of the window of the bilateral average.
_BILATERAL_RADIUS = 3
# Smaller noise (1 / m) is quantisation: exact depth is not filtered.
_MIN_NOISE = 2e-4
# Number of resolutions at which the noise is estimated: full, half and quarter.
_LEVELS = 3


def without_gaps(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill missing pixels between two neighbours on opposite sides that belong to one surface.

    Args:
        inverse: [H, W] inverse depth in 1 / m, 0 where missing.

    Returns:
        [H, W] with the mean of the pairs of opposite neighbours in the gaps, otherwise unchanged.
    """
    module = kernels()
    if module is None:
        return _without_gaps_numpy(inverse)
    inverse, filled = np.ascontiguousarray(inverse), np.empty(inverse.shape, np.float32)
    size = inverse.shape[::-1]
    module.fill_depth_gaps(size, inverse.ctypes.data, _MAX_DIFFERENCE, filled.ctypes.data)
    return filled


def _without_gaps_numpy(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """As `without_gaps`, in NumPy: reference and fallback of the native kernel."""
    width = inverse.shape[1] + 2
    padded = np.pad(inverse, 1).reshape(-1)
    rows, columns = np.nonzero(inverse == 0)
    places = (rows + 1) * width + columns + 1
    total, count = np.zeros((2, len(places)), np.float32)
    for step in (1, width - 1, width, width + 1):
        one, other = padded[places - step], padded[places + step]
        mean = 0.5 * (one + other)
        closed = (one > 0) & (other > 0) & (np.abs(one - other) < _MAX_DIFFERENCE * mean)
        total += np.where(closed, mean, 0.0)
        count += closed
    gap = count > 0
    filled = inverse.copy()
    filled[rows[gap], columns[gap]] = total[gap] / count[gap]
    return filled


class DepthFilter:
    """Filters the frames of a sequence; another thread may call `prepare` for later frames."""

    def __init__(self) -> None:
        self._prepared: dict[int, tuple[Frame, Frame]] = {}

    def prepare(self, frame: Frame) -> Frame:
        """Filter a frame, and cache the result for `of`."""
        filtered = _filtered(frame)
        self._prepared[frame.index] = frame, filtered
        return filtered

    def of(self, frame: Frame, measured: bool = True) -> Frame:
        """The filtered frame, computed now or by `prepare`.

        Args:
            measured: a sensor measured the depth; that of priors has no flying pixels.
        """
        original, filtered = self._prepared.pop(frame.index, (None, None))
        if filtered is not None and original is frame:
            return filtered
        return _filtered(frame, measured)


def _filtered(frame: Frame, measured: bool = True) -> Frame:
    focal = frame.camera.focal if measured and frame.inferred is None else None
    return replace(frame, depth_m=denoised(frame.depth_m, focal))


@dataclass(frozen=True)
class _Window:
    """Sums over the window around each pixel."""

    radius: int

    def sum(self, image: NDArray[np.float64], u: int = 0, v: int = 0) -> NDArray[np.float64]:
        """Sum of x^u y^v times the image, with x to the right and y down from the centre."""
        steps = np.arange(-self.radius, self.radius + 1, dtype=np.float64)
        return cv2.sepFilter2D(
            image, cv2.CV_64F, steps**u, steps**v, borderType=cv2.BORDER_CONSTANT
        )


def inverse_depth_noise(depth_m: NDArray[np.float32]) -> float:
    """Robust standard deviation (1 / m) of the noise in inverse depth.

    On a plane, second differences consist of noise only. Those of neighbouring pixels miss noise
    that is correlated between neighbours: quantisation steps, and blotches of sensors that match
    patches. These show in means over 2x2 and 4x4 pixels, which contain less white noise. The
    result is the largest of the three estimates.
    """
    inverse = _inverse(depth_m[_sampled_rows(len(depth_m))])
    noise = 0.0
    for _ in range(_LEVELS):
        noise = max(noise, _noise_between_neighbours(inverse))
        inverse = _halved(inverse)
    return noise


def _sampled_rows(height: int) -> NDArray[np.int64]:
    """A third of the rows, in groups that can be halved."""
    group = 2 ** (_LEVELS - 1)
    starts = np.arange(0, height - group + 1, 3 * group)
    return (starts[:, None] + np.arange(group)).reshape(-1)


def _inverse(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.divide(1.0, depth_m, out=np.zeros(depth_m.shape, np.float32), where=depth_m > 0)


def _halved(inverse: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over 2x2 pixels; 0 unless all four are measured."""
    height, width = (size // 2 * 2 for size in inverse.shape)
    a, b, c, d = (inverse[i:height:2, j:width:2] for i in (0, 1) for j in (0, 1))
    valid = (a > 0) & (b > 0) & (c > 0) & (d > 0)
    return np.where(valid, (a + b + c + d) / 4.0, 0.0).astype(np.float32)


def _noise_between_neighbours(inverse: NDArray[np.float32]) -> float:
    left, centre, right = inverse[:, :-2], inverse[:, 1:-1], inverse[:, 2:]
    measured = (left > 0) & (centre > 0) & (right > 0)
    differences = np.abs((left - 2.0 * centre + right)[measured])
    if not differences.size:
        return 0.0
    # Median absolute value of a normal variable of variance 1 + 4 + 1.
    return float(np.median(differences) / (0.6745 * np.sqrt(6.0)))


def denoised(depth_m: NDArray[np.float32], focal: float | None = None) -> NDArray[np.float32]:
    """Filter depth [H, W] (m, 0 missing), and close gaps of a pixel inside of surfaces.

    Other missing pixels stay missing. Depth without noise is not changed otherwise.

    Args:
        focal: focal length in pixels, to remove flying pixels as well.
    """
    noise, inverse = inverse_depth_noise(depth_m), _inverse(depth_m)
    kept = inverse if focal is None else without_flying_pixels(inverse, focal, noise)
    if noise < _MIN_NOISE:
        return depth_m if kept is inverse else np.where(kept > 0, depth_m, np.float32(0.0))
    return _inverse(_smoothed(without_gaps(kept), noise))


def _smoothed(inverse: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    image = torch.from_numpy(inverse)
    module = kernels_for(image)
    if module is None:
        return _smoothed_numpy(inverse, noise)
    out = image.new_empty(image.shape)
    module.smooth_inverse_depth(
        inverse.shape[::-1],
        address(image),
        _RADII,
        _BILATERAL_RADIUS,
        (noise, _MAX_EXCESS_SIGMAS, _MIN_VALID_FRACTION, _EDGE_SIGMAS * noise),
        address(out),
    )
    return out.numpy()


def _smoothed_numpy(inverse: NDArray[np.float32], noise: float) -> NDArray[np.float32]:
    """Smooth in NumPy: reference and fallback of the native kernel."""
    d = inverse.astype(np.float64)
    measured = inverse > 0
    smooth = np.zeros_like(d)
    for radius in _RADII:
        planes = _planes(d, measured.astype(np.float64), _Window(radius), noise)
        smooth = np.where(measured & (smooth == 0), planes, smooth)
    remaining = measured & ~(smooth > 0)
    return np.where(remaining, _bilateral_mean(d, noise), smooth).astype(np.float32)


def _planes(
    d: NDArray[np.float64], one: NDArray[np.float64], window: _Window, noise: float
) -> NDArray[np.float64]:
    """Value [H, W] at the centre of the plane fitted to each window; 0 if it is not planar."""
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
    planar = n >= _MIN_VALID_FRACTION * (2 * window.radius + 1) ** 2
    planar &= determinant > MIN_PLANE_DETERMINANT * uu * vv
    determinant = np.where(planar, determinant, 1.0)
    slope_u = (ud * vv - vd * uv) / determinant
    slope_v = (vd * uu - ud * uv) / determinant
    degrees_of_freedom = np.where(planar, n - 3.0, 1.0)
    variance = (dd - slope_u * ud - slope_v * vd) / degrees_of_freedom
    excess = _MAX_EXCESS_SIGMAS * np.sqrt(2.0 / degrees_of_freedom)
    planar &= variance <= noise**2 * (1.0 + excess)
    return np.where(planar, mean - slope_u * u - slope_v * v, 0.0)


def _bilateral_mean(d: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """Mean [H, W] of the neighbours on the same surface, weighted by proximity and similarity."""
    radius = _BILATERAL_RADIUS
    padded = np.pad(d, radius)
    height, width = d.shape
    total, weights = np.zeros_like(d), np.full_like(d, 1e-12)
    for j in range(2 * radius + 1):
        for i in range(2 * radius + 1):
            other = padded[j : j + height, i : i + width]
            distance = ((i - radius) ** 2 + (j - radius) ** 2) / (radius + 1) ** 2
            similarity = np.maximum(1.0 - ((other - d) / (_EDGE_SIGMAS * noise)) ** 2, 0.0)
            weight = max(1.0 - distance, 0.0) * similarity**2 * (other > 0)
            total += weight * (other - d)
            weights += weight
    return d + total / weights
