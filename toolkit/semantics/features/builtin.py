"""Built-in encoder without learned weights: edges, hues and lightness in a pyramid of windows.

Similar to HOG (Dalal and Triggs 2005) and GIST (Oliva and Torralba 2001): three groups of eight
maps, each summed in sixteen soft windows, which gives 3 x 8 x 16 = 384 numbers.

- edges: gradient magnitude of lightness in eight orientations,
- hues: colour magnitude in eight directions of the opponent colour plane,
- lightness: soft assignment to eight levels.

The lightness of the image is normalised to mean 0 and standard deviation 1, so the descriptor is
invariant to gain and bias of the exposure. Wide windows are robust to shifts. Indoor cameras
mostly rotate about the vertical axis, so windows are narrower vertically than horizontally.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from toolkit.semantics.features.encoder import check_images, unit_length

_ROWS, _COLUMNS = 120, 160  # image size for edges; hues and lightness use half of it
_MAPS = 8  # maps per group
_WINDOWS = ((6, 2), (2, 2))  # rows and columns at each level of the pyramid
_WINDOW_WIDTH = 0.6  # standard deviation of a window, in units of their distance
_LIGHTNESS_WEIGHT = 0.5  # illumination differs between visits
_DARKEST, _LIGHTEST = -1.75, 1.75  # centres of the outer levels, in standard deviations
# Squared gradients and colours below these (in standard deviations squared) are noise.
_FLAT, _GREY = 1e-6, 1e-4
_MIN_VARIANCE = 1e-6  # avoids division by zero for uniform images
_CELL_ROWS, _CELL_COLUMNS = 60, 80  # size of the downscaled image
_BINS = (8, 8, 6)  # number of bins of red, green and blue; 384 in total
# Added to all bins, so that gradients of the square root are finite at empty bins.
_MIN_FRACTION = 1e-4


class BuiltinEncoder:
    """Encoder of three groups of eight maps in sixteen windows; see the module docstring.

    The threshold accepts 1 % of the pairs of views with less than 10 % overlap and 88 % of the
    pairs within 0.3 m and 15 degrees, measured with random exposure on five recordings of rooms,
    two of them real. The same threshold is valid for semantic images.
    """

    name = "builtin"
    dimensions = 3 * _MAPS * sum(rows * columns for rows, columns in _WINDOWS)
    threshold = 0.20
    differentiable = True

    def __init__(self) -> None:
        self._windows = _pyramid(_ROWS // 2, _COLUMNS // 2)

    def describe(self, images: Tensor) -> Tensor:
        """Descriptors [B, 384] of images [B, 3, H, W]; see `Encoder.describe`."""
        check_images(images)
        images = functional.adaptive_avg_pool2d(images.float(), (_ROWS, _COLUMNS))
        lightness, colour = _standardised(images)
        edges = self._in_windows(_halved(_edges(lightness)))
        hues = self._in_windows(_hues(_halved(colour)))
        levels = self._in_windows(_levels(_halved(lightness)))
        return unit_length(torch.cat([edges, hues, _LIGHTNESS_WEIGHT * levels], dim=1))

    def _in_windows(self, maps: Tensor) -> Tensor:
        """Sum non-negative maps [B, 8, H, W] in the windows and normalise to unit norm, [B, 128].

        The square root reduces the influence of a few strong edges.
        """
        sums = maps.flatten(2) @ self._windows.to(maps.device)
        return unit_length((sums + _FLAT).sqrt().flatten(1))


def _standardised(images: Tensor) -> tuple[Tensor, Tensor]:
    """Return lightness [B, 1, H, W] and opponent colour [B, 2, H, W], invariant to exposure."""
    lightness = images.mean(dim=1, keepdim=True)
    variance, mean = torch.var_mean(lightness, dim=(2, 3), keepdim=True)
    red, green, blue = images.split(1, dim=1)
    # Differences of channels are invariant to bias.
    colour = torch.cat([red - green, (red + green) / 2.0 - blue], dim=1)
    deviation = (variance + _MIN_VARIANCE).sqrt()
    return (lightness - mean) / deviation, colour / deviation


def _edges(lightness: Tensor) -> Tensor:
    """Return gradient magnitudes [B, 8, H, W] by orientation, of lightness [B, 1, H, W]."""
    padded = functional.pad(lightness, (1, 1, 1, 1), mode="replicate")
    x = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2.0
    y = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2.0
    # Doubling the angle makes a gradient and its opposite equal.
    return _by_direction(x * x - y * y, 2.0 * x * y, x * x + y * y + _FLAT)


def _hues(colour: Tensor) -> Tensor:
    """Return colour magnitudes [B, 8, H, W] by direction in the opponent plane [B, 2, H, W]."""
    a, b = colour.split(1, dim=1)
    squares = a * a + b * b + _GREY
    root = squares.sqrt()
    return _by_direction(a * root, b * root, squares)


def _by_direction(x: Tensor, y: Tensor, squares: Tensor) -> Tensor:
    """Distribute magnitudes sqrt(squares) over eight directions of (x, y), [B, 8, H, W].

    Args:
        x, y: [B, 1, H, W], vectors of norm at most `squares`.
        squares: [B, 1, H, W], squared magnitudes, positive.
    """
    angles = torch.arange(_MAPS, device=x.device).to(x) * (2.0 * math.pi / _MAPS)
    cosine, sine = (f(angles).view(1, -1, 1, 1) for f in (torch.cos, torch.sin))
    weights = ((x * cosine + y * sine) / squares).clamp_min(0.0)
    return squares.sqrt() * weights * weights


def _levels(lightness: Tensor) -> Tensor:
    """Return linear soft assignments [B, 8, H, W] of lightness [B, 1, H, W] to eight levels."""
    middles = torch.linspace(
        _DARKEST, _LIGHTEST, _MAPS, dtype=lightness.dtype, device=lightness.device
    )
    step = (_LIGHTEST - _DARKEST) / (_MAPS - 1)
    distance = (lightness.clamp(_DARKEST, _LIGHTEST) - middles.view(1, -1, 1, 1)).abs()
    return (1.0 - distance / step).clamp_min(0.0)


def _halved(maps: Tensor) -> Tensor:
    return functional.avg_pool2d(maps, 2)


def _pyramid(rows: int, columns: int) -> Tensor:
    """Return the weights [rows * columns, 16] of the windows, each with sum 1."""
    windows = []
    for down, across in _WINDOWS:
        vertical, horizontal = _gaussian_windows(rows, down), _gaussian_windows(columns, across)
        windows.append(np.einsum("ya,xb->yxab", vertical, horizontal).reshape(rows * columns, -1))
    return torch.from_numpy(np.concatenate(windows, axis=1).astype(np.float32))


def _gaussian_windows(pixels: int, count: int) -> np.ndarray:
    """Return Gaussian weights [pixels, count] around equidistant centres, each with sum 1."""
    spacing = pixels / count
    middles = (np.arange(count) + 0.5) * spacing
    offsets = (np.arange(pixels)[:, None] + 0.5 - middles) / (_WINDOW_WIDTH * spacing)
    windows = np.exp(-0.5 * offsets**2)
    return np.asarray(windows / windows.sum(axis=0))


class ColourHistogramEncoder:
    """Square root of a histogram of 8 x 8 x 6 colours with linear interpolation between bins.

    The distance of two descriptors is sqrt(2) times the Hellinger distance. The threshold was
    measured like that of `BuiltinEncoder`.
    """

    name = "colour-histogram"
    dimensions = _BINS[0] * _BINS[1] * _BINS[2]
    threshold = 0.40
    differentiable = True

    def describe(self, images: Tensor) -> Tensor:
        """Descriptors [B, 384] of images [B, 3, H, W]; see `Encoder.describe`."""
        check_images(images)
        small = functional.adaptive_avg_pool2d(images.float(), (_CELL_ROWS, _CELL_COLUMNS)).flatten(
            2
        )
        red, green, blue = (
            _memberships(channel, bins)
            for channel, bins in zip(small.unbind(1), _BINS, strict=True)
        )
        histogram = torch.einsum("bpi,bpj,bpk->bijk", red, green, blue).flatten(1)
        histogram = histogram / (_CELL_ROWS * _CELL_COLUMNS)
        return unit_length((histogram + _MIN_FRACTION).sqrt())


def _memberships(values: Tensor, bins: int) -> Tensor:
    """Return the linear weights [B, P, bins] of values [B, P] in [0, 1], with sum 1."""
    middles = (torch.arange(bins).to(values) + 0.5) / bins
    inside = values.clamp(0.5 / bins, 1.0 - 0.5 / bins)
    return (1.0 - (inside[..., None] - middles).abs() * bins).clamp_min(0.0)
