"""Removes noise and single wrong pixels from depth priors."""

from __future__ import annotations

import cv2
import numpy as np

from toolkit.depth_priors.provider import Image

# Relative noise between neighbouring pixels above which depth is filtered once, and twice.
_SMALL, _LARGE = 0.02, 0.08
_WINDOW = 5


def without_outliers(depth_m: Image) -> Image:
    """Replace noisy depth [H, W] by the median around each pixel.

    Depth that is smooth between neighbours, as that of most models, is returned unchanged, and
    missing depth (0) stays missing.
    """
    known = depth_m > 0
    if not known.any():
        return depth_m
    inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=known)
    local = cv2.medianBlur(inverse, _WINDOW)
    compared = known & (local > 0)
    if not compared.any():
        return depth_m
    noise = 1.4826 * float(np.median(np.abs(inverse[compared] / local[compared] - 1.0)))
    if noise < _SMALL:
        return depth_m
    if noise > _LARGE:
        local = cv2.medianBlur(local, _WINDOW)
    return np.divide(1.0, local, out=np.zeros_like(depth_m), where=known & (local > 0))
