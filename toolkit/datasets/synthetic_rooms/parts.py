"""Parts: surfaces of one class and one texture. A piece of furniture is a list of parts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.datasets.synthetic_rooms.patches import TexturedPatch
from toolkit.datasets.synthetic_rooms.textures import Texture

# Parts of one class whose bounding boxes are at most this far apart are one object.
_TOUCHING_M = 0.01


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
        object_id: number of the object that the part belongs to, 0 for none.
        T_room_piece: [4, 4] motion since the piece was made; the front of pieces is towards -y.
    """

    class_name: str
    patches: list[TexturedPatch]
    texture: Texture
    rng: np.random.Generator
    glow: float = 0.0
    finish: Finish = Finish.MATT
    object_id: int = 0
    T_room_piece: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def transformed(self, T_new_old: NDArray[np.float64]) -> Part:
        """Return the part transformed by a rigid motion [4, 4]."""
        patches = [patch.transformed(T_new_old) for patch in self.patches]
        return replace(self, patches=patches, T_room_piece=T_new_old @ self.T_room_piece)


def moved(parts: list[Part], T_new_old: NDArray[np.float64]) -> list[Part]:
    """Transform all parts by a rigid motion [4, 4]."""
    return [part.transformed(T_new_old) for part in parts]


def bounds(parts: list[Part]) -> NDArray[np.float64]:
    """Return the minimum and maximum corner [2, 3] of all points, metres."""
    points = np.concatenate([p.points.reshape(-1, 3) for part in parts for p in part.patches])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def with_object_ids(parts: list[Part], first: int) -> list[Part]:
    """Number the objects of a piece of furniture: parts of one class that touch are one object.

    A pillow is another object than the bed below it, and than the other pillow.

    Args:
        parts: of one piece, all with their bounding boxes along the axes.
        first: number of the first object.
    """
    boxes = [bounds([part]) for part in parts]
    numbers: list[int] = []
    for k, part in enumerate(parts):
        touched = {
            numbers[j]
            for j in range(k)
            if parts[j].class_name == part.class_name and _touch(boxes[j], boxes[k])
        }
        number = min(touched, default=max([first - 1, *numbers]) + 1)
        numbers = [number if n in touched else n for n in numbers] + [number]
    return [replace(part, object_id=n) for part, n in zip(parts, numbers, strict=True)]


def _touch(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    gap = np.maximum(one[0] - other[1], other[0] - one[1])
    return bool((gap <= _TOUCHING_M).all())
