"""Canvas on which a texture is painted: a chart in metres, with noise and soft edges.

All patterns are band-limited by the texel size: octaves of noise below two texels are omitted and
edges are about one texel wide. A finer chart shows the same pattern with more detail.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.floating]


@dataclass(frozen=True)
class Canvas:
    """One chart.

    Attributes:
        size: (width, height) in texels.
        texel_m: edge of a texel, metres.
        rng: source of randomness of this chart.
    """

    size: tuple[int, int]
    texel_m: float
    rng: np.random.Generator

    @property
    def size_m(self) -> tuple[float, float]:
        """(width, height) in metres."""
        return self.size[0] * self.texel_m, self.size[1] * self.texel_m

    def coordinates(self) -> tuple[Image, Image]:
        """Return the coordinates u (right) and v (down) [h, w] of the texel centres, metres."""
        u = (np.arange(self.size[0], dtype=np.float32) + 0.5) * self.texel_m
        v = (np.arange(self.size[1], dtype=np.float32) + 0.5) * self.texel_m
        grid_u, grid_v = np.meshgrid(u, v)
        return grid_u, grid_v

    def noise(self, wavelength_m: float | tuple[float, float], octaves: int = 1) -> Image:
        """Return smooth noise [h, w] of about unit standard deviation.

        Args:
            wavelength_m: wavelength of the first octave, or a pair of wavelengths along u and v.
            octaves: number of octaves, each with half the wavelength and amplitude of the
                previous one; octaves below two texels are omitted.
        """
        pair = wavelength_m if isinstance(wavelength_m, tuple) else (wavelength_m, wavelength_m)
        total = np.zeros((self.size[1], self.size[0]), dtype=np.float32)
        for octave, rng in enumerate(self.rng.spawn(octaves)):
            wavelength = (pair[0] / 2**octave, pair[1] / 2**octave)
            if max(wavelength) < 2 * self.texel_m:
                break
            total += self._octave(wavelength, rng) * 0.5**octave
        return total

    def _octave(self, wavelength_m: tuple[float, float], rng: np.random.Generator) -> Image:
        # Two grid values per wavelength, interpolated bicubically.
        cell_u, cell_v = (max(w, 2 * self.texel_m) / 2 for w in wavelength_m)
        columns = math.ceil(self.size_m[0] / cell_u) + 4
        rows = math.ceil(self.size_m[1] / cell_v) + 4
        grid = rng.standard_normal((rows, columns)).astype(np.float32)
        scale = np.array([self.texel_m / cell_u, self.texel_m / cell_v])
        # The matrix maps texels to grid cells; the offset avoids the border.
        offset = 1.5 + 0.5 * scale
        matrix = np.array([[scale[0], 0.0, offset[0]], [0.0, scale[1], offset[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(grid, matrix, self.size, flags=flags, borderMode=cv2.BORDER_REFLECT)

    def pulse(self, coordinate_m: Image, period_m: float, width_m: float) -> Image:
        """Return a soft mask [h, w] of periodic bands centred at multiples of the period."""
        distance = np.abs((coordinate_m / period_m + 0.5) % 1.0 - 0.5) * period_m
        return self.inside(width_m / 2 - distance)

    def lines(self, coordinate_m: Image, period_m: float, width_m: float) -> Image:
        """Return the fraction [h, w] of each texel that periodic thin lines cover.

        They are centred at odd multiples of half the period. Lines thinner than a texel are faint
        instead of too wide.
        """
        distance = np.abs(coordinate_m / period_m % 1.0 - 0.5) * period_m
        covered = ((width_m + self.texel_m) / 2 - distance) / self.texel_m
        return np.clip(covered, 0.0, min(1.0, width_m / self.texel_m))

    def inside(self, distance_m: Image) -> Image:
        """Return a soft mask [h, w] of a signed distance in metres, positive inside."""
        return np.clip(distance_m / (1.5 * self.texel_m) + 0.5, 0.0, 1.0)

    def flat(self, colour: NDArray | tuple[float, float, float]) -> Image:
        """Return an image [h, w, 3] of one colour."""
        return np.broadcast_to(
            np.asarray(colour, dtype=np.float32), (self.size[1], self.size[0], 3)
        ).copy()


def mix(under: Image, over: Image | tuple[float, float, float], mask: Image) -> Image:
    """Blend an image or colour over an image [h, w, 3] with a mask [h, w]."""
    return under + (np.asarray(over, dtype=np.float32) - under) * mask[..., None]
