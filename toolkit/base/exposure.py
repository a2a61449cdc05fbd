"""Exposure: difference in colour between two images of the same surface.

Automatic exposure changes all channels alike; automatic white balance changes each by its own
factor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

# Colours or intensities in [0, 1].
Image = TypeVar("Image", Tensor, NDArray[np.float32], NDArray[np.float64])
Balance = tuple[float, float, float]

NEUTRAL: Balance = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Exposure:
    """Exposure of an image against a reference: reference = balance * (gain * image + bias).

    Attributes:
        gain: contrast of the reference relative to the image, > 0.
        bias: offset, intensities in [0, 1].
        balance: white balance, additional gains of red, green and blue, > 0. They change the hue;
            the mean intensity of the image follows from gain and bias alone.
    """

    gain: float = 1.0
    bias: float = 0.0
    balance: Balance = field(default=NEUTRAL, kw_only=True)

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Exposure:
        """Exposure from JSON values with the names of the attributes."""
        red, green, blue = (float(value) for value in values["balance"])
        return cls(float(values["gain"]), float(values["bias"]), balance=(red, green, blue))

    def apply(self, image: Image) -> Image:
        """Convert colours [..., 3] to the exposure of the reference; the image itself if equal."""
        if (self.gain, self.bias) != (1.0, 0.0):
            image = image * self.gain + self.bias
        return image if self.balance == NEUTRAL else image * _channels(self.balance, image)

    def undo(self, reference: Image) -> Image:
        """Convert colours [..., 3] of the reference to the exposure of the image."""
        if self.balance != NEUTRAL:
            reference = reference / _channels(self.balance, reference)
        return (reference - self.bias) / self.gain

    def after(self, inner: Exposure) -> Exposure:
        """Compose: the exposure that applies `inner` first and this one second.

        With different gains of the channels, the small bias of this exposure is approximate.
        """
        gain, bias = self.gain * inner.gain, self.gain * inner.bias + self.bias
        return Exposure(gain, bias, balance=_product(self.balance, inner.balance))

    def inverse(self) -> Exposure:
        """The exposure of the reference against the image; the bias is approximate as above."""
        red, green, blue = self.balance
        balance = (1.0 / red, 1.0 / green, 1.0 / blue)
        return Exposure(1.0 / self.gain, -self.bias / self.gain, balance=balance)

    def with_balance(self, balance: Balance) -> Exposure:
        """The same gain and bias with another white balance."""
        return replace(self, balance=balance)


IDENTITY = Exposure()


def _product(a: Balance, b: Balance) -> Balance:
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


def _channels(balance: Balance, image: Image) -> Image:
    """The gains [3] in the form of an image."""
    if isinstance(image, Tensor):
        return image.new_tensor(balance)
    return np.array(balance, image.dtype)
