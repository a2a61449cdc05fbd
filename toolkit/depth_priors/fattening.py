"""Foreground fattening: matched depth of near surfaces reaches beyond their borders in the image.

The window around a pixel beside a near surface shows that surface too, and often its border has the
strongest contrast in the window. The pixel is then given the depth of the near surface, in all
images alike, so that keyframes agree on it.
"""

from __future__ import annotations

import cv2
import numpy as np

from toolkit.depth_priors import native, reference
from toolkit.depth_priors.problem import Image
from toolkit.native.loading import kernels

# Width of the wrong borders: half a window of the image of half the size.
_WIDTH = 6
# Ratio of the inverse depths of neighbouring pixels on different surfaces.
_EDGE = 1.05


def remove_fattening(intensity: Image, inverse_depth: Image) -> Image:
    """Remove the depth of pixels that belong to the surface behind the one of their depth.

    Pixels on the near side of a depth edge are compared with both surfaces, of which they have the
    intensity that is more frequent there.

    Args:
        intensity: [H, W] float32 in [0, 1].
        inverse_depth: [H, W] float32, 0 where unknown.

    Returns:
        [H, W] float32 inverse depth, 0 where unknown or removed.
    """
    # A 3x3 window beside a depth edge shows what is behind it.
    known = np.where(inverse_depth > 0, inverse_depth, np.float32(np.inf))
    far = _least(known, 3)
    edge = (known < np.inf) & (known > np.float32(_EDGE) * far)
    behind = _least(np.where(edge, far, np.float32(np.inf)), 2 * _WIDTH + 1)
    module = kernels()
    if module is None:
        return reference.remove_fattening(intensity, inverse_depth, behind)
    return native.remove_fattening(module, intensity, inverse_depth, behind)


def _least(image: Image, side: int) -> Image:
    """Least value [H, W] of the square around each pixel."""
    square = np.ones((side, side), np.uint8)
    return np.asarray(cv2.erode(image, square, borderType=cv2.BORDER_REPLICATE), np.float32)
