"""A walk through the painted box, as plane sweeps see it."""

from __future__ import annotations

import numpy as np
import pytest
from moving_camera import film, walk

from toolkit.base.geometry import se3
from toolkit.base.native import load_variant
from toolkit.depth.depth_priors import coarse_to_fine, consensus, plane_sweep
from toolkit.depth.depth_priors.problem import Image, NeighbourView
from toolkit.splatting.alignment.levels import intensity_of

POSES = walk(9)[::2]
FRAMES = film(POSES)
CAMERA = FRAMES[0].camera
IMAGES = [intensity_of(frame.rgb).numpy() for frame in FRAMES]
TRUE = [np.asarray(1.0 / frame.depth_m, np.float32) for frame in FRAMES]
NEAR, FAR = 1.2, 4.0


def T_from_to(number: int, other: int) -> np.ndarray:
    return se3.inverse(POSES[other]) @ POSES[number]


def posed(images: list[Image], number: int, *others: int) -> list[NeighbourView]:
    return [NeighbourView(images[n], T_from_to(number, n)) for n in others]


def relative_error(inverse_depth: Image, number: int) -> np.ndarray:
    """Errors of the pixels with depth."""
    known = inverse_depth > 0
    return np.abs(TRUE[number][known] / inverse_depth[known] - 1.0)


def use_kernels(monkeypatch: pytest.MonkeyPatch, name: str | None) -> None:
    """Use the kernels of one instruction set, or the reference."""
    variant = None if name is None else load_variant(name)
    for module in (plane_sweep, consensus, coarse_to_fine):
        monkeypatch.setattr(module, "kernels", lambda: variant)
