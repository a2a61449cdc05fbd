"""Names of colours: the eleven basic colour terms of English (Berlin and Kay, 1969)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

# Typical sRGB values of each term: colours of paints and materials in rooms. A colour has the name
# of the nearest one in CIELAB.
_TYPICAL = {
    "black": ((20, 20, 22), (40, 38, 38)),
    "grey": ((90, 90, 92), (130, 130, 130), (170, 170, 172)),
    "white": ((215, 213, 208), (240, 240, 240), (255, 255, 255)),
    "red": ((200, 30, 30), (150, 25, 30), (215, 70, 60)),
    "orange": ((235, 125, 30), (220, 105, 50)),
    "yellow": ((240, 215, 50), (205, 180, 60), (230, 215, 130)),
    "green": ((50, 140, 60), (90, 120, 60), (120, 190, 110), (30, 75, 45)),
    "blue": ((40, 80, 190), (30, 45, 100), (100, 150, 215), (60, 130, 160)),
    "purple": ((110, 50, 140), (150, 100, 180), (80, 45, 90)),
    "pink": ((235, 150, 175), (225, 95, 145)),
    "brown": ((115, 70, 40), (80, 50, 32), (155, 110, 70), (190, 150, 105)),
}
COLOUR_NAMES = tuple(_TYPICAL)


def colour_name(rgb: NDArray[np.floating], weights: NDArray[np.floating]) -> str:
    """Return the name of the colour that covers the largest part of a surface.

    Args:
        rgb: [N, 3] sRGB colours in [0, 1], N >= 1.
        weights: [N] areas.
    """
    share = np.bincount(_nearest(rgb), weights=weights, minlength=len(_TYPICAL))
    return COLOUR_NAMES[int(share.argmax())]


def colour_table() -> NDArray[np.uint8]:
    """Return the index [32, 32, 32] into COLOUR_NAMES of colours with 5 bits per channel."""
    channels = np.stack(np.meshgrid(*[np.arange(32)] * 3, indexing="ij"), axis=-1)
    return _nearest((channels.reshape(-1, 3) + 0.5) / 32.0).reshape(32, 32, 32).astype(np.uint8)


def _nearest(rgb: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return the index [N] into COLOUR_NAMES of colours [N, 3] in [0, 1]."""
    typical = np.array([value for values in _TYPICAL.values() for value in values], np.float32)
    owner = np.repeat(np.arange(len(_TYPICAL)), [len(values) for values in _TYPICAL.values()])
    gap = np.linalg.norm(_lab(rgb)[:, None] - _lab(typical / 255.0), axis=2)
    return np.asarray(owner[gap.argmin(axis=1)])


def _lab(rgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return CIELAB values [N, 3]."""
    image = np.clip(rgb, 0.0, 1.0).astype(np.float32)[None]
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2LAB)[0], np.float32)
