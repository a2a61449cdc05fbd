"""Baseline encoder: global colour histogram."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from toolkit.features.encoder import check_images, unit_length

_ROWS, _COLUMNS = 60, 80  # size of the downscaled image
_BINS = (8, 8, 6)  # number of bins of red, green and blue; 384 in total
# Added to all bins, so that gradients of the square root are finite at empty bins.
_MIN_FRACTION = 1e-4


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
        small = functional.adaptive_avg_pool2d(images.float(), (_ROWS, _COLUMNS)).flatten(2)
        red, green, blue = (
            _memberships(channel, bins)
            for channel, bins in zip(small.unbind(1), _BINS, strict=True)
        )
        histogram = torch.einsum("bpi,bpj,bpk->bijk", red, green, blue).flatten(1)
        histogram = histogram / (_ROWS * _COLUMNS)
        return unit_length((histogram + _MIN_FRACTION).sqrt())


def _memberships(values: Tensor, bins: int) -> Tensor:
    """Return the linear weights [B, P, bins] of values [B, P] in [0, 1], with sum 1."""
    middles = (torch.arange(bins, device=values.device) + 0.5) / bins
    inside = values.clamp(0.5 / bins, 1.0 - 0.5 / bins)
    return (1.0 - (inside[..., None] - middles).abs() * bins).clamp_min(0.0)
