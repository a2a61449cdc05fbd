"""Check that depth images are registered to colour images.

At depth discontinuities colour mostly changes as well. The correlation of depth edges with
colour gradients must therefore be largest without a shift between the images. Single frames are
noisy, so the correlation is summed over frames. It is also computed for each quarter of the
image, because a wrong focal length shifts opposite sides in opposite directions.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame

# Images are resized to about this width, so that shifts in pixels are comparable.
_WIDTH = 320
# Maximum shift, in pixels of the resized image.
_REACH = 16
# Minimum depth step of an edge, relative to the nearer depth.
RELATIVE_STEP = 0.08
# Colour gradients are clipped at this quantile, so that single strong edges do not dominate.
_CLIP_QUANTILE = 0.95

# Measured on TUM (fr1/rpy), 7-Scenes (RedKitchen) and Replica (office 0) with 3 to 30 frames
# each. Registered images: best shift within 2 px at a width of 640, prominence 3.3 to 6.9.
# Shifted by 6 or 12 px: advantage 0.3 to 0.95. Mirrored, mispaired or with depth scaled by 1.1:
# prominence 1.7 to 2.8.
_CLEAR_FIT = 3.0
_CLEAR_FIT_OF_QUARTER = 3.3
_CLEAR_ADVANTAGE = 0.25
_TOLERANCE = 5 / 640
# Images narrower than _WIDTH blur edges of colour, by motion too, more than those of depth: the
# best shift is less certain.
_TOLERANCE_PX = 2.5
# A registered sequence may have a low prominence (1.9, noisy rooms at 160x120). Its frames still
# correlate on average more than by chance near zero shift: 1.15 standard deviations or more, where
# mirrored and mispaired images have up to 1.
_CHANCE = 1.1
# Depth edges count if they are contours of at least so many pixels; others are noise of far depth.
# They must be in most quarters of the image: the edge of a single door may be beside one of colour.
_CONTOUR_PIXELS = 16
_ENOUGH_EDGE_PIXELS, _ENOUGH_IN_QUARTER, _MIN_PARTS = 1500, 100, 3
# Texture without depth edges may mislead a single quarter, and all if it is in one of them.
_ENOUGH_QUARTERS = 2


@dataclass(frozen=True)
class RegistrationReport:
    """Shifts with the largest correlation of depth edges and colour gradients.

    Attributes:
        shift_px: [5, 2] shifts (x, y) of colour relative to depth in pixels of the original
            images: for the whole image and its quarters (top left, top right, bottom left,
            bottom right).
        prominence: [5] correlation at the best shift above the mean over all shifts, in standard
            deviations.
        advantage: [5] decrease of the correlation from the best shift to zero shift, relative to
            the best; 0 if zero shift is the best.
        near_zero: maximum over shifts within the tolerance of the correlation, as prominence, but
            of each frame and averaged over frames.
        edge_pixels: number of pixels of contours at depth edges.
        width: width of the original images in pixels.
        parts: number of quarters of the image with such contours.
    """

    shift_px: NDArray[np.float64]
    prominence: NDArray[np.float64]
    advantage: NDArray[np.float64]
    near_zero: float
    edge_pixels: int
    width: int
    parts: int = 4

    def verdict(self) -> str | None:
        """Return a one-line description of the defect, or None if edges agree or are too few."""
        if self.edge_pixels < _ENOUGH_EDGE_PIXELS or self.parts < _MIN_PARTS:
            return None
        remedy = "register depth to colour, and check that the files are paired correctly"
        quarters = range(1, 5)
        shifted = sum(self._shifted(part) for part in quarters)
        agrees = any(
            self._is_near(part) and self.prominence[part] >= _CLEAR_FIT_OF_QUARTER
            for part in quarters
        )
        clear = self.prominence[0] >= _CLEAR_FIT
        if clear and self._shifted(0) and not agrees:
            x, y = self.shift_px[0]
            return f"colour is shifted relative to depth by ({x:+.0f}, {y:+.0f}) px; {remedy}"
        if shifted >= _ENOUGH_QUARTERS or not (clear or self.near_zero >= _CHANCE):
            return f"edges of colour and depth do not agree for any shift; {remedy}"
        return None

    def _shifted(self, part: int) -> bool:
        clear = _CLEAR_FIT if part == 0 else _CLEAR_FIT_OF_QUARTER
        return bool(
            not self._is_near(part)
            and self.prominence[part] >= clear
            and self.advantage[part] >= _CLEAR_ADVANTAGE
        )

    def _is_near(self, part: int) -> bool:
        return bool(np.linalg.norm(self.shift_px[part]) <= _tolerance_px(self.width))


def measure_registration(frames: Iterable[Frame]) -> RegistrationReport:
    """Correlate depth edges with colour gradients over frames of one camera."""
    total = np.zeros((5, 2 * _REACH + 1, 2 * _REACH + 1))
    standardised, frames_seen = np.zeros_like(total[0]), 0
    edge_pixels, width = np.zeros(4, np.int64), _WIDTH
    for frame in frames:
        width = frame.camera.width
        scale = width / _WIDTH
        size = (_WIDTH, round(frame.camera.height / scale))
        depth_m = cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT)
        rgb = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
        edges = depth_edges(np.asarray(depth_m, dtype=np.float32))
        gradient = _colour_gradient(np.asarray(rgb, dtype=np.float32))
        contours, padded = _contours(edges), np.pad(gradient, _REACH)
        parts = _quarters(edges.shape)
        edge_pixels += [np.count_nonzero(contours[part]) for part in parts]
        quarters = [_correlation(edges, padded, *part) for part in parts]
        total[1:] += quarters
        standardised += _standardised(np.sum(quarters, axis=0))
        frames_seen += 1
    total[0] = total[1:].sum(axis=0)
    return _report(total, standardised / max(frames_seen, 1), width, edge_pixels)


def depth_edges(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an edge image [H, W]: 1 on the near side of depth steps, 0 at other pixels.

    Missing depth beside an object is usually the sensor's shadow on the background, so holes are
    filled with the larger depth of their ends.
    """
    edges = np.zeros(depth_m.shape, dtype=bool)
    for axis in (0, 1):
        filled = np.moveaxis(_filled_with_farther(np.moveaxis(depth_m, axis, 1)), 1, axis)
        for step in (-1, 1):
            neighbour = np.roll(filled, step, axis=axis)
            valid = (depth_m > 0) & (neighbour > 0)
            edges |= valid & (neighbour - depth_m > RELATIVE_STEP * depth_m)
    # np.roll wraps around, so the border is invalid.
    edges[[0, -1], :] = False
    edges[:, [0, -1]] = False
    return edges.astype(np.float32)


def _contours(edges: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels [H, W] of edges that are connected to enough others."""
    _, parts, statistics, _ = cv2.connectedComponentsWithStats(edges.astype(np.uint8))
    large = statistics[:, cv2.CC_STAT_AREA] >= _CONTOUR_PIXELS
    large[0] = False
    return np.asarray(large[parts], bool)


def _filled_with_farther(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill holes within each row of an image [H, W] with the larger depth of their ends."""
    valid, pixels = depth_m > 0, np.arange(depth_m.size).reshape(depth_m.shape)
    left = np.maximum.accumulate(np.where(valid, pixels, pixels[:, :1]), axis=1)
    right = np.where(valid, pixels, pixels[:, -1:])[:, ::-1]
    right = np.minimum.accumulate(right, axis=1)[:, ::-1]
    return np.maximum(depth_m.take(left), depth_m.take(right))


def _colour_gradient(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return clipped colour gradient magnitudes [H, W] with mean 0."""
    smooth = cv2.GaussianBlur(rgb, (0, 0), 1.0)
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    red, green, blue = np.moveaxis(across**2 + down**2, 2, 0)
    return clipped(np.sqrt(red + green + blue))


def clipped(strength: NDArray[np.float32]) -> NDArray[np.float32]:
    """Gradient magnitudes [H, W], clipped and scaled to [0, 1], less their mean."""
    ceiling = max(float(np.quantile(strength, _CLIP_QUANTILE)), 1e-6)
    scaled = np.minimum(strength, ceiling) / ceiling
    return np.asarray(scaled - scaled.mean(), np.float32)


def _quarters(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Rows and columns of the quarters of an image."""
    rows, columns = ((slice(0, n // 2), slice(n // 2, n)) for n in shape)
    return list(itertools.product(rows, columns))


def _correlation(
    edges: NDArray[np.float32], padded: NDArray[np.float32], rows: slice, columns: slice
) -> NDArray[np.float64]:
    """Return the sum over a part of edges(p) * gradient(p + shift) for all shifts (y, x).

    Args:
        padded: the gradient with a border of the largest shift.
    """
    reached = tuple(slice(part.start, part.stop + 2 * _REACH) for part in (rows, columns))
    found = cv2.matchTemplate(padded[reached], edges[rows, columns], cv2.TM_CCORR)
    return np.asarray(found, np.float64)


def _standardised(surface: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((surface - surface.mean()) / max(float(surface.std()), 1e-12))


def _tolerance_px(width: int) -> float:
    return max(_TOLERANCE * width, _TOLERANCE_PX)


def _report(
    total: NDArray[np.float64],
    mean: NDArray[np.float64],
    width: int,
    edge_pixels: NDArray[np.int64],
) -> RegistrationReport:
    scale = width / _WIDTH
    shifts, prominences, advantages = [], [], []
    for height in map(_standardised, total):
        row, column = np.unravel_index(int(np.argmax(height)), height.shape)
        best, centre = height[row, column], height[_REACH, _REACH]
        shifts.append([(column - _REACH) * scale, (row - _REACH) * scale])
        prominences.append(best)
        advantages.append((best - centre) / best if best > 0 else 0.0)
    reach = round(_tolerance_px(width) / scale)
    near = slice(_REACH - reach, _REACH + reach + 1)
    return RegistrationReport(
        np.array(shifts),
        np.array(prominences),
        np.array(advantages),
        float(mean[near, near].max()),
        int(edge_pixels.sum()),
        width,
        int((edge_pixels >= _ENOUGH_IN_QUARTER).sum()),
    )
