"""Finishes of surfaces: what a glossy room reflects, and how strongly."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

# Textures have display values; light adds up in linear ones.
_GAMMA = 2.2


class Finish(IntEnum):
    """Finish of a surface in a glossy room; in an ordinary room, every surface is matt."""

    MATT = 0
    LACQUER = 1
    """A clear coat over the texture, as of a polished floor."""
    SCREEN = 2
    """Dark glass, as of a display that is switched off."""
    MIRROR = 3
    HUNG_MIRROR = 4
    """A mirror in a frame, in place of a picture; its glass is a MIRROR."""


# Reflectance at normal incidence: the dielectrics have refractive indices of 1.7 and 1.5.
LACQUER_REFLECTANCE = 0.07
_REFLECTANCE = np.zeros(len(Finish), dtype=np.float32)
_REFLECTANCE[[Finish.SCREEN, Finish.MIRROR]] = 0.04, 0.92


def reflectance(
    finish: NDArray[np.uint8],
    cosine: NDArray[np.float32],
    lacquer: float = LACQUER_REFLECTANCE,
) -> NDArray[np.float32]:
    """Fraction [N] of the light that surfaces reflect as a mirror (Schlick's approximation).

    Args:
        finish: [N] values of `Finish`.
        cosine: [N] cosine of the angle between ray and normal, in [0, 1].
        lacquer: reflectance of lacquered surfaces at normal incidence.
    """
    normal = np.where(finish == Finish.LACQUER, np.float32(lacquer), _REFLECTANCE[finish])
    grazing = (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5
    return np.where(normal > 0, normal + (1.0 - normal) * grazing, 0.0).astype(np.float32)


def coated(
    colour: NDArray[np.float32], reflected: NDArray[np.float32], share: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Colours [N, 3] of surfaces whose coat reflects a share [N] of the light.

    Args:
        colour: [N, 3] display values below the coat, at least 0.
        reflected: [N, 3] display values of what is reflected, at least 0.
        share: [N] from `reflectance`.
    """
    weight = share[:, None]
    light = (1.0 - weight) * colour**_GAMMA + weight * reflected**_GAMMA
    return np.asarray(light ** (1.0 / _GAMMA), dtype=np.float32)
