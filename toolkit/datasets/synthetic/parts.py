"""A part: some surfaces of one class and one texture. Furniture is a list of parts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic.patches import Patch
from toolkit.datasets.synthetic.textures import Texture


@dataclass(frozen=True)
class Part:
    """Surfaces that share a class and a texture.

    Attributes:
        class_name: one of Replica's.
        patches: its surfaces, metres.
        texture: paints each patch's chart.
        rng: for the texture; two parts with equal streams look the same.
        glow: least shading in [0, 1]: 0 for matter, 1 for screens and lamps.
    """

    class_name: str
    patches: list[Patch]
    texture: Texture
    rng: np.random.Generator
    glow: float = 0.0

    def transformed(self, T_new_old: NDArray[np.float64]) -> Part:
        """The part moved rigidly by a motion [4, 4]."""
        return replace(self, patches=[patch.transformed(T_new_old) for patch in self.patches])


def moved(parts: list[Part], T_new_old: NDArray[np.float64]) -> list[Part]:
    """All parts moved rigidly by a motion [4, 4]."""
    return [part.transformed(T_new_old) for part in parts]


def bounds(parts: list[Part]) -> NDArray[np.float64]:
    """Lowest and highest corner [2, 3] of all points, metres."""
    points = np.concatenate([p.points.reshape(-1, 3) for part in parts for p in part.patches])
    return np.stack([points.min(axis=0), points.max(axis=0)])
