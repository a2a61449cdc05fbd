"""Removes noise and single wrong pixels from depth priors."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from toolkit.depth.depth_priors.provider import Image, PriorImage

# Relative noise between neighbouring pixels from which values are filtered.
_MIN_NOISE = 0.02
_MEDIAN_WINDOW = 5
# Half the width of the window for little and for much noise, and the limit between them.
_RADII, _MUCH_NOISE = (4, 7), 0.1
# Mean shift: rounds, and width of the kernel in standard deviations of the noise.
_ROUNDS, _WIDTH = 5, 0.7


def without_outliers(prior: PriorImage) -> PriorImage:
    """Replace noisy values by the most frequent value around each pixel.

    Means and medians would be biased where most wrong values lie on one side. Values that are
    smooth between neighbours, as those of most models, are returned unchanged. Unknown values stay
    unknown.
    """
    known = prior.known & (prior.values > 0)
    values = np.where(known, prior.values, np.float32(0.0))
    if not known.any():
        return prior
    median = cv2.medianBlur(values, _MEDIAN_WINDOW)
    compared = known & (median > 0)
    if not compared.any():
        return prior
    noise = 1.4826 * float(np.median(np.abs(values[compared] / median[compared] - 1.0)))
    if noise < _MIN_NOISE:
        return prior
    mode = np.where(median > 0, median, 1.0)
    for _ in range(_ROUNDS):
        mode = _mean_around(values, mode, _WIDTH * noise, _RADII[noise > _MUCH_NOISE])
    return replace(prior, values=mode, known=compared)


def _mean_around(values: Image, mode: Image, width: float, radius: int) -> Image:
    """Mean [H, W] of the values around each pixel, weighted by their closeness to a mode [H, W]."""
    height, width_px = values.shape
    padded = cv2.copyMakeBorder(values, *(radius,) * 4, cv2.BORDER_CONSTANT, value=0.0)
    total, weights = np.zeros_like(mode), np.full_like(mode, 1e-12)
    # Noise is proportional to the value.
    inverse = (1.0 / (width * mode)).astype(np.float32)
    for row in range(2 * radius + 1):
        for column in range(2 * radius + 1):
            other = padded[row : row + height, column : column + width_px]
            weight = np.exp(-0.5 * ((other - mode) * inverse) ** 2) * (other > 0)
            total += weight * other
            weights += weight
    return np.where(weights > 1e-6, total / weights, mode).astype(np.float32)
