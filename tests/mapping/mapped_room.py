"""Feeding a mapper true poses, and measuring what became of its map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from mapped_submap import MappedSubmap
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.splatting.rendering import render


def fed(mapper: MappedSubmap, room: Any, numbers: Iterable[int]) -> MappedSubmap:
    """The mapper after these frames of a room."""
    for number in numbers:
        mapper.add_keyframe(Keyframe.from_frame(room.frames[number], room.T_map_camera[number]))
    return mapper


def psnr_db(mapper: MappedSubmap, frame: Frame, T_map_camera: NDArray[np.float64]) -> float:
    """PSNR of the map against a frame, over all pixels."""
    drawn = render(mapper.gaussians, frame.camera, se3.inverse(T_map_camera))
    return float(-10 * np.log10(((drawn.colour.numpy() - frame.rgb) ** 2).mean()))


def depth_error_m(
    mapper: MappedSubmap, frame: Frame, T_map_camera: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Drawn minus measured depth where both are, [M]."""
    drawn = render(mapper.gaussians, frame.camera, se3.inverse(T_map_camera))
    both = (drawn.silhouette.numpy() > 0.5) & (frame.depth_m > 0)
    return (drawn.depth_m.numpy() - frame.depth_m)[both]


def same_bits(one: MappedSubmap, other: MappedSubmap) -> bool:
    """Whether Gaussians, optimiser, keyframes and generator agree to the last bit."""
    (arrays, values), (others, other_values) = one.state(), other.state()
    if arrays.keys() != others.keys() or repr(values) != repr(other_values):
        return False
    return all(arrays[name].tobytes() == others[name].tobytes() for name in arrays)
