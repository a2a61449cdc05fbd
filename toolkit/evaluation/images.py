"""Image quality of a rendered view: PSNR, SSIM and MS-SSIM (LPIPS is in `lpips.py`).

PSNR is computed over all pixels of a view; the mean over views is the mean of the dB values.
SSIM (Wang et al. 2004) and MS-SSIM (Wang et al. 2003) are different metrics: SplaTAM and
Hier-SLAM report MS-SSIM under the name SSIM.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Image = NDArray[np.float32] | Tensor

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
# The original MS-SSIM weights, finest scale first.
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# The PSNR of identical images is infinite. At this limit, the error is that of float32.
MAX_PSNR_DB = 100.0

_MARGIN = WINDOW_SIZE // 2
_C1, _C2 = 0.01**2, 0.03**2


def psnr_db(rendered: Image, truth: Image) -> float:
    """Compute the peak signal-to-noise ratio in dB over all pixels and channels, at most 100.

    Args:
        rendered, truth: [H, W, 3] in [0, 1], numpy or torch; values outside are clamped.

    Raises:
        ValueError: shapes differ or are not [H, W, 3].
    """
    a, b = _as_pair(rendered, truth)
    mean_square = float(np.mean((a - b) ** 2))
    if mean_square <= 10.0 ** (-MAX_PSNR_DB / 10.0):
        return MAX_PSNR_DB
    return -10.0 * math.log10(mean_square)


def ssim(rendered: Image, truth: Image) -> float | None:
    """Compute the structural similarity: 11x11 Gaussian window, sigma 1.5, data range 1.

    The result is the mean over all pixels and channels with a mirrored border, as in
    torchmetrics.

    Args:
        rendered, truth: [H, W, 3] in [0, 1], numpy or torch; values outside are clamped.

    Returns:
        SSIM, at most 1; None for an image smaller than the window.

    Raises:
        ValueError: shapes differ or are not [H, W, 3].
    """
    a, b = _as_pair(rendered, truth)
    if min(a.shape[:2]) < WINDOW_SIZE:
        return None
    similarity, _ = _ssim_maps(a, b)
    return float(similarity.mean())


def ms_ssim(rendered: Image, truth: Image) -> float | None:
    """Compute the multi-scale structural similarity over five scales, each half the previous.

    As in torchmetrics, contrast is averaged over pixels whose window lies inside the image, the
    similarity of the coarsest scale over all pixels, and both over all channels.

    Args:
        rendered, truth: [H, W, 3] in [0, 1], numpy or torch; values outside are clamped.

    Returns:
        MS-SSIM in [0, 1]. None if the shorter side is below 176 pixels: the window would not
        fit in the coarsest scale, and values for fewer scales are not comparable.

    Raises:
        ValueError: shapes differ or are not [H, W, 3].
    """
    a, b = _as_pair(rendered, truth)
    if min(a.shape[:2]) < WINDOW_SIZE * 2 ** (len(MS_SSIM_WEIGHTS) - 1):
        return None
    product = 1.0
    for scale, weight in enumerate(MS_SSIM_WEIGHTS):
        if scale > 0:
            a, b = _halved(a), _halved(b)
        similarity, contrast = _ssim_maps(a, b)
        is_coarsest = scale == len(MS_SSIM_WEIGHTS) - 1
        inside = contrast[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
        factor = float((similarity if is_coarsest else inside).mean())
        # Anticorrelated structure gives a negative factor, which has no real fractional power.
        product *= max(factor, 0.0) ** weight
    return product


def mean_or_none(values: Sequence[float | None]) -> float | None:
    """Return the mean of the values that are not None, or None if there are none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _as_pair(rendered: Image, truth: Image) -> tuple[Array, Array]:
    """Convert both images to float64: variances are differences of nearly equal numbers."""
    pair = []
    for name, image in (("rendered", rendered), ("truth", truth)):
        if image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(f"{name} must have shape [H, W, 3], got {list(image.shape)}")
        values = image.detach().cpu().numpy() if isinstance(image, Tensor) else image
        pair.append(np.clip(values.astype(np.float64), 0.0, 1.0))
    if pair[0].shape != pair[1].shape:
        raise ValueError(
            f"images must have the same size, got {list(rendered.shape)} and {list(truth.shape)}"
        )
    return pair[0], pair[1]


def _ssim_maps(a: Array, b: Array) -> tuple[Array, Array]:
    """Return SSIM and its contrast-structure factor, each [H, W, 3]."""
    mean_a, mean_b = _blur(a), _blur(b)
    variance_a = _blur(a * a) - mean_a**2
    variance_b = _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    contrast = (2.0 * covariance + _C2) / (variance_a + variance_b + _C2)
    luminance = (2.0 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    return luminance * contrast, contrast


def _blur(image: Array) -> Array:
    """Filter with the Gaussian window and a mirrored border."""
    size = (WINDOW_SIZE, WINDOW_SIZE)
    blurred = cv2.GaussianBlur(image, size, WINDOW_SIGMA, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, dtype=np.float64)


def _halved(image: Array) -> Array:
    """Average blocks of 2x2 pixels; an odd last row or column is dropped."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    blocks = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, 3)
    return np.asarray(blocks.mean(axis=(1, 3)))
