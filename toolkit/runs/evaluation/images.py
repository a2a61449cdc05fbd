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
Image = NDArray[np.float32] | NDArray[np.float64] | Tensor

WINDOW_SIZE = 11
WINDOW_SIGMA = 1.5
# The original MS-SSIM weights, finest scale first.
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# The PSNR of identical images is infinite. At this limit, the error is that of float32.
MAX_PSNR_DB = 100.0

_MARGIN = WINDOW_SIZE // 2
_C1, _C2 = 0.01**2, 0.03**2
# Pulls gains towards 1, in mean squares of colours in [0, 1]: a dark channel determines no gain.
_PRIOR = 1e-3
# Largest residual of a pixel that the gains are fitted to; larger ones are errors of the map.
_MAX_RESIDUAL = 0.15
_ROUNDS = 3


def psnr_db(rendered: Image, truth: Image, ignored: NDArray[np.bool_] | None = None) -> float:
    """Compute the peak signal-to-noise ratio in dB over all pixels and channels, at most 100.

    Args:
        rendered, truth: [H, W, 3] in [0, 1], numpy or torch; values outside are clamped.
        ignored: [H, W] pixels that are left out, not all; None for none.

    Raises:
        ValueError: shapes differ or are not [H, W, 3].
    """
    a, b = _as_pair(rendered, truth)
    squares = (a - b) ** 2
    mean_square = float(np.mean(squares if ignored is None else squares[~ignored]))
    if mean_square <= 10.0 ** (-MAX_PSNR_DB / 10.0):
        return MAX_PSNR_DB
    return -10.0 * math.log10(mean_square)


def masked_psnr_db(rendered: Image, truth: Image, mask: NDArray[np.bool_]) -> float | None:
    """Compute the PSNR in dB over the pixels in a mask [H, W] only; None if it is empty.

    Args:
        rendered, truth: as in `psnr_db`.

    Raises:
        ValueError: shapes differ or are not [H, W, 3].
    """
    a, b = _as_pair(rendered, truth)
    # Both images as one row of pixels.
    return psnr_db(a[mask][None], b[mask][None]) if mask.any() else None


def ssim_and_ms_ssim(rendered: Image, truth: Image) -> tuple[float | None, float | None]:
    """Compute SSIM, and MS-SSIM over five scales, each half the previous; both as in torchmetrics.

    SSIM has an 11x11 Gaussian window of sigma 1.5, data range 1, and is the mean over all pixels
    and channels with a mirrored border. The contrast of MS-SSIM is averaged over pixels whose
    window lies inside the image, the similarity of the coarsest scale over all pixels, and both
    over all channels.

    Args:
        rendered, truth: [H, W, 3] in [0, 1], numpy or torch; values outside are clamped.

    Returns:
        SSIM, at most 1, None for an image smaller than the window. MS-SSIM in [0, 1], None if the
        shorter side is below 176 pixels: the window would not fit in the coarsest scale, and
        values for fewer scales are not comparable.

    Raises:
        ValueError: shapes differ or are not [H, W, 3].
    """
    a, b = _as_pair(rendered, truth)
    if not _fits(a, 1):
        return None, None
    finest = _Statistics(a, b)
    several = _fits(a, len(MS_SSIM_WEIGHTS))
    return _ssim_of(finest), _ms_ssim_of(a, b, finest) if several else None


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


def _fits(image: Array, scales: int) -> bool:
    """Whether the window fits into the coarsest of some scales of an image."""
    return min(image.shape[:2]) >= WINDOW_SIZE * 2 ** (scales - 1)


class _Statistics:
    """Local statistics of two images [H, W, 3].

    Attributes:
        contrast: contrast-structure factor of SSIM [H, W, 3].
    """

    def __init__(self, a: Array, b: Array) -> None:
        mean_a, mean_b = _blur(a), _blur(b)
        self._product, self._squares = mean_a * mean_b, mean_a**2 + mean_b**2
        covariance = _blur(a * b) - self._product
        variances = _blur(a * a + b * b) - self._squares
        self.contrast: Array = (2.0 * covariance + _C2) / (variances + _C2)

    def similarity(self) -> Array:
        """SSIM [H, W, 3]."""
        luminance = (2.0 * self._product + _C1) / (self._squares + _C1)
        return np.asarray(luminance * self.contrast)


def _ssim_of(finest: _Statistics) -> float:
    return float(finest.similarity().mean())


def _ms_ssim_of(a: Array, b: Array, finest: _Statistics) -> float:
    product, statistics = 1.0, finest
    for scale, weight in enumerate(MS_SSIM_WEIGHTS):
        if scale > 0:
            a, b = _halved(a), _halved(b)
            statistics = _Statistics(a, b)
        is_coarsest = scale == len(MS_SSIM_WEIGHTS) - 1
        inside = statistics.contrast[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
        factor = float((statistics.similarity() if is_coarsest else inside).mean())
        # Anticorrelated structure gives a negative factor, which has no real fractional power.
        product *= max(factor, 0.0) ** weight
    return product


def _blur(image: Array) -> Array:
    """Filter with the Gaussian window and a mirrored border."""
    size = (WINDOW_SIZE, WINDOW_SIZE)
    blurred = cv2.GaussianBlur(image, size, WINDOW_SIGMA, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(blurred, dtype=np.float64)


def _halved(image: Array) -> Array:
    """Average blocks of 2x2 pixels; an odd last row or column is dropped."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    size = (width, height)
    even = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), dtype=np.float64)


def balanced(rendered: NDArray[np.float32], observed: NDArray[np.float32]) -> NDArray[np.float32]:
    """The rendered colours [H, W, 3], with one gain per channel that fits the observed ones."""
    gains = np.ones(3)
    for _ in range(_ROUNDS):
        good = (np.abs(gains * rendered - observed) < _MAX_RESIDUAL).all(axis=-1)
        r, o = rendered[good].astype(np.float64), observed[good].astype(np.float64)
        count = max(len(rendered.reshape(-1, 3)), 1)
        prior = _PRIOR * count
        gains = ((r * o).sum(axis=0) + prior) / ((r * r).sum(axis=0) + prior)
    return (gains * rendered).clip(0.0, 1.0).astype(np.float32)
