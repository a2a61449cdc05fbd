"""Constant offset, in fractions of a pixel, of depth images from colour images.

A registration that is wrong by a pixel gives the rim of each object the colour of what is behind
it. At steps of the depth, the colour mostly changes as well, so the gradient of the colour across
the step, as a function of the distance from it, has a peak at the offset. Sensors that enlarge or
shrink objects move the peaks of opposite sides of objects in opposite directions; therefore the
sides are measured separately, and the offset is the mean of both.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.datasets.registration_check import RELATIVE_STEP, clipped

_SMOOTHING_PX = 1.0
# Distances from the edge, in half pixels, at which the gradient is sampled.
_DISTANCES = np.arange(-16, 17)
# The peak of single samples is flat, because the edge lies between two pixels. This window, of
# about a standard deviation of one pixel, makes the middle of the profile's bump its peak.
_WINDOW = cv2.getGaussianKernel(9, 2.0)[:, 0]
# Frames take turns in this number of groups, whose spread gives the standard error.
_GROUPS = 4
# Each side of objects needs this number of edge pixels along both axes.
_MIN_EDGE_PIXELS = 300
_MAX_SIGMA_PX = 0.4
# Where opposite sides differ more, sensors enlarge objects less than that: holes hide their edges.
_MAX_ENLARGED_PX = 1.5
# Number of evenly spaced frames of a recording for an estimate.
OFFSET_FRAMES = 40

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthOffset:
    """Offset of colour images from depth images.

    Attributes:
        x_px: a point at column c of the depth image is at column c + x_px of the colour image.
        y_px: the same for rows.
        sigma_px: standard error of the less certain one of both; infinite without enough edges.
        enlarged_px: (x, y) by which objects are larger in depth than in colour, on each side.
        edge_pixels: number of depth edge pixels.
    """

    x_px: float
    y_px: float
    sigma_px: float
    enlarged_px: tuple[float, float]
    edge_pixels: int

    @property
    def fault(self) -> str | None:
        """Why the edges do not determine the offset, or None if they do."""
        if not np.isfinite(self.sigma_px):
            return f"there are only {self.edge_pixels} pixels at depth edges"
        if self.sigma_px > _MAX_SIGMA_PX:
            return f"groups of frames differ by {self.sigma_px:.1f} px"
        if max(map(abs, self.enlarged_px)) > _MAX_ENLARGED_PX:
            return "opposite sides of objects disagree"
        return None

    def __str__(self) -> str:
        return f"({self.x_px:+.2f}, {self.y_px:+.2f}) px"


def estimate_depth_offset(frames: Iterable[Frame]) -> DepthOffset:
    """Estimate the offset of colour from depth over frames of one camera.

    Args:
        frames: at least `_GROUPS` of them, from different views.
    """
    # [group, axis, side, distance] and [group, axis, side].
    profiles = np.zeros((_GROUPS, 2, 2, len(_DISTANCES)))
    counts = np.zeros((_GROUPS, 2, 2), np.int64)
    for number, frame in enumerate(frames):
        group = number % _GROUPS
        for axis, gradient in enumerate(_gradients(frame.rgb)):
            for side, (columns, rows) in enumerate(_edges(frame.depth_m, axis)):
                profiles[group, axis, side] += _profile(gradient, columns, rows, axis)
                counts[group, axis, side] += len(columns)
    edge_pixels = int(counts.sum())
    if counts.sum(axis=0).min() < _MIN_EDGE_PIXELS:
        return DepthOffset(0.0, 0.0, float("inf"), (0.0, 0.0), edge_pixels)
    near, far = (_peaks(profiles.sum(axis=0)[:, side]) for side in (0, 1))
    offset = 0.5 * (near + far)
    groups = np.array([[_peaks(sides).mean() for sides in group] for group in profiles])
    sigma = groups.std(axis=0, ddof=1) / np.sqrt(_GROUPS)
    enlarged = 0.5 * (near - far)
    return DepthOffset(
        float(offset[0]),
        float(offset[1]),
        float(sigma.max()),
        (float(enlarged[0]), float(enlarged[1])),
        edge_pixels,
    )


def _gradients(rgb: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Clipped strengths [H, W] of the colour gradient along x and y, with mean 0."""
    smooth = cv2.GaussianBlur(rgb, (0, 0), _SMOOTHING_PX)
    strengths = []
    for x, y in ((1, 0), (0, 1)):
        strengths.append(clipped(np.abs(cv2.Sobel(smooth, cv2.CV_32F, x, y)).max(axis=2)))
    return strengths[0], strengths[1]


def _edges(depth_m: NDArray[np.float32], axis: int) -> list[tuple[Array, Array]]:
    """Columns and rows [N] of depth steps along an axis (0: x): near after far, far after near.

    Only steps between two measured pixels count, because holes are as wide as the sensor's shadow.
    """
    image = depth_m if axis == 0 else depth_m.T
    before, after = image[:, :-1], image[:, 1:]
    step = (before > 0) & (after > 0)
    step &= np.abs(before - after) > RELATIVE_STEP * np.minimum(before, after)
    sides: list[tuple[Array, Array]] = []
    for side in (after < before, before < after):
        rows, columns = np.nonzero(step & side)
        along, across = columns.astype(np.float64) + 0.5, rows.astype(np.float64)
        sides.append((along, across) if axis == 0 else (across, along))
    return sides


def _profile(gradient: NDArray[np.float32], columns: Array, rows: Array, axis: int) -> Array:
    """Sums of the gradient [H, W] at all distances from the edges along an axis."""
    along, across, image = (columns, rows, gradient) if axis == 0 else (rows, columns, gradient.T)
    # Pixels at even indices, means of neighbours at odd ones.
    doubled = np.empty((len(image), 2 * image.shape[1] - 1), np.float32)
    doubled[:, ::2] = image
    doubled[:, 1::2] = 0.5 * (image[:, :-1] + image[:, 1:])
    at = (2.0 * along).astype(np.int64)[:, None] + _DISTANCES
    inside = (at >= 0) & (at < doubled.shape[1])
    at = np.where(inside, at, 0)
    return np.asarray((doubled[across.astype(np.int64)[:, None], at] * inside).sum(axis=0))


def _peaks(profiles: Array) -> Array:
    """Positions [N], in pixels, of the peaks of profiles [N, distance], between the samples."""
    peaks = []
    for profile in profiles:
        smooth = np.convolve(profile, _WINDOW, mode="valid")
        distances = 0.5 * np.convolve(_DISTANCES, _WINDOW, mode="valid")
        top = int(np.clip(np.argmax(smooth), 1, len(smooth) - 2))
        left, middle, right = smooth[top - 1 : top + 2]
        curvature = left - 2.0 * middle + right
        shift = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
        peaks.append(distances[top] + 0.5 * float(np.clip(shift, -1.0, 1.0)))
    return np.array(peaks)
