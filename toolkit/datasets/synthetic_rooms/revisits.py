"""What has changed in a room when the camera returns to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.canvas import Canvas, Image
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.shell import RoomPlan
from toolkit.datasets.synthetic_rooms.textures import Texture

# Factors of red, green and blue: a single warm lamp, and windows without daylight.
_EVENING = (0.62, 0.5, 0.36)
_LAMP_INSET_M, _LAMP_HEIGHT_M = 0.6, 1.3


@dataclass(frozen=True)
class Revisit:
    """Changes of the first room in the second half of the frames.

    Attributes:
        moved: most of its objects are elsewhere; the largest ones and pictures stay.
        dark: its ceiling lamps are off.
        evening: a warm lamp in a corner lights it instead of ceiling lamps and daylight.
        repainted: every surface has another colour, and what was bright is dark for half of them.
    """

    moved: bool = False
    dark: bool = False
    evening: bool = False
    repainted: bool = False

    def __bool__(self) -> bool:
        """Whether anything changes."""
        return self.moved or self.dark or self.evening or self.repainted

    def appearance(self, parts: Sequence[Part], seed: int) -> list[Part]:
        """Return the parts of the room with their new colours; `seed` chooses them."""
        changed = list(parts)
        if self.repainted:
            rngs = np.random.default_rng(seed).spawn(len(changed))
            changed = [
                replace(part, texture=_repainted(part.texture, rng))
                for part, rng in zip(changed, rngs, strict=True)
            ]
        if self.evening:
            changed = [replace(part, texture=_tinted(part.texture, _EVENING)) for part in changed]
        return changed

    def lamps_m(self, plan: RoomPlan, ceiling_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the centres [L, 3] of the lamps that are on, for ceiling lamps [K, 3], metres."""
        if self.evening:
            x0, y0, _, _ = plan.bounds_m
            return np.array([[x0 + _LAMP_INSET_M, y0 + _LAMP_INSET_M, _LAMP_HEIGHT_M]])
        return ceiling_m[:0] if self.dark else ceiling_m


def _tinted(texture: Texture, factors: tuple[float, float, float]) -> Texture:
    return lambda canvas: texture(canvas) * np.array(factors, np.float32)


def _repainted(texture: Texture, rng: np.random.Generator) -> Texture:
    """The same pattern around another colour, for half of the textures in negative."""
    colour, sign = rng.uniform(0.25, 0.8, 3).astype(np.float32), rng.choice([-1.0, 1.0])
    order = rng.permutation(3)

    def paint(canvas: Canvas) -> Image:
        image = texture(canvas)
        pattern = image - image.mean(axis=(0, 1))
        return np.clip(colour + np.float32(sign) * pattern[..., order], 0.02, 1.0)

    return paint
