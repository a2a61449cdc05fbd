"""Glossy rooms: which surfaces reflect, and the depth that a camera measures on them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.patches import TexturedPatch, plate
from toolkit.datasets.synthetic_rooms.vocabulary import MIRROR

# Below the coat: what a mirror and a switched-off screen do not reflect.
_SILVER, _BLACK = (0.3, 0.32, 0.32), (0.05, 0.05, 0.055)
# A coat sends part of the scattered light back, so that surfaces look darker, as if they were wet.
_WET = 0.6
_FRAME, _FRAME_M = (0.24, 0.16, 0.1), 0.045
# Distance of the glass from the front of its frame's back board.
_RAISED_M = 0.0015
# Screens return depth between these cosines of the viewing angle: seen from the front, they send
# the light of the projector back as glare, and at grazing angles away from the camera.
RETURNED_COSINES = (0.4, 0.75)
# Range of the depth camera. The files of a room hold depth below 10 m.
FARTHEST_M = 8.0


@dataclass(frozen=True)
class Reflection:
    """What the surfaces of a view reflect, at pixel centres.

    Attributes:
        finish: [H, W] uint8 values of `Finish`.
        surface_m: [H, W] float32 z-depth of the surfaces, 0 where none is hit.
        image_m: [H, W] float32 z-depth of the mirror image: that of the reflected surface, seen
            behind the reflecting one; 0 where nothing is reflected.
    """

    finish: NDArray[np.uint8]
    surface_m: NDArray[np.float32]
    image_m: NDArray[np.float32]


def measured_depth(reflection: Reflection, cosine: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth [H, W] that a structured-light or time-of-flight camera measures, 0 where missing.

    A mirror returns the light of what it shows, so the mirror image is measured, if it is within
    the range of the camera. A lacquered floor scatters enough light for its own depth. Screens
    return depth at middle angles only.

    Args:
        reflection: what the surfaces reflect.
        cosine: [H, W] cosine of the angle between ray and normal.
    """
    low, high = RETURNED_COSINES
    lost = (reflection.finish == Finish.SCREEN) & ((cosine < low) | (cosine > high))
    mirror = reflection.finish == Finish.MIRROR
    lost |= mirror & (reflection.image_m > FARTHEST_M)
    seen_m = np.where(mirror, reflection.image_m, reflection.surface_m)
    return np.where(lost, np.float32(0.0), seen_m)


def polished(parts: list[Part]) -> list[Part]:
    """Parts of a glossy room: screens are off, mirrors are mirrors, frames have glass in them."""
    return [new for part in parts for new in _polished(part)]


def _polished(part: Part) -> list[Part]:
    if part.finish is Finish.LACQUER:
        return [replace(part, texture=tx.darkened(part.texture, _WET))]
    if part.finish is Finish.SCREEN:
        return [replace(part, texture=tx.plaster(_BLACK, 0.0), glow=0.0)]
    if part.finish is Finish.MIRROR:
        return [replace(part, class_name=MIRROR, texture=tx.plaster(_SILVER, 0.0))]
    if part.finish is Finish.HUNG_MIRROR:
        frame = replace(part, class_name=MIRROR, texture=tx.wood(_FRAME), finish=Finish.MATT)
        glass = replace(
            frame,
            patches=[_inset(part.patches[0])],
            texture=tx.plaster(_SILVER, 0.0),
            finish=Finish.MIRROR,
        )
        return [frame, glass]
    return [part]


def _inset(front: TexturedPatch) -> TexturedPatch:
    """The glass in front of the front plate of a picture, inside of its frame."""
    corner, right, down = front.points[0, 0], front.points[0, -1], front.points[-1, 0]
    right, down = right - corner, down - corner
    across, along = (v / np.linalg.norm(v) for v in (right, down))
    start = corner + _FRAME_M * (across + along) + _RAISED_M * front.normals()[0, 0]
    return plate(start, right - 2 * _FRAME_M * across, down - 2 * _FRAME_M * along)
