"""Affine exposure: difference in intensity between two images of the same surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

# Colours or intensities in [0, 1].
Image = TypeVar("Image", Tensor, NDArray[np.float32])


@dataclass(frozen=True)
class Exposure:
    """Exposure of an image against a reference: reference = gain * image + bias.

    Attributes:
        gain: contrast of the reference relative to the image, > 0.
        bias: offset, intensities in [0, 1].
    """

    gain: float = 1.0
    bias: float = 0.0

    def apply(self, image: Image) -> Image:
        """Convert colours to the exposure of the reference."""
        return image * self.gain + self.bias

    def undo(self, reference: Image) -> Image:
        """Convert colours of the reference to the exposure of the image."""
        return (reference - self.bias) / self.gain

    def after(self, inner: Exposure) -> Exposure:
        """Compose: the exposure that applies `inner` first and this one second."""
        return Exposure(self.gain * inner.gain, self.gain * inner.bias + self.bias)


IDENTITY = Exposure()
