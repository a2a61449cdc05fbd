"""Parts: surfaces of one class and one texture. A piece of furniture is a list of parts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.synthetic_rooms.finishes import Finish
from toolkit.synthetic_rooms.patches import TexturedPatch
from toolkit.synthetic_rooms.textures import Texture


@dataclass(frozen=True)
class Part:
    """Surfaces that share a class and a texture.

    Attributes:
        class_name: a class name of the room's vocabulary, by default Replica's.
        patches: surfaces, metres.
        texture: paints the chart of each patch.
        rng: random stream of the texture; parts with equal streams look the same.
        glow: minimum brightness in [0, 1]: 0 for ordinary surfaces, 1 for screens and lamps.
        finish: of the surfaces in glossy rooms.
    """

    class_name: str
    patches: list[TexturedPatch]
    texture: Texture
    rng: np.random.Generator
    glow: float = 0.0
    finish: Finish = Finish.MATT

    def transformed(self, T_new_old: NDArray[np.float64]) -> Part:
        """Return the part transformed by a rigid motion [4, 4]."""
        return replace(self, patches=[patch.transformed(T_new_old) for patch in self.patches])


def moved(parts: list[Part], T_new_old: NDArray[np.float64]) -> list[Part]:
    """Transform all parts by a rigid motion [4, 4]."""
    return [part.transformed(T_new_old) for part in parts]


def bounds(parts: list[Part]) -> NDArray[np.float64]:
    """Return the minimum and maximum corner [2, 3] of all points, metres."""
    points = np.concatenate([p.points.reshape(-1, 3) for part in parts for p in part.patches])
    return np.stack([points.min(axis=0), points.max(axis=0)])
