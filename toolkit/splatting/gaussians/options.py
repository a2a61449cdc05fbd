"""Options of seeding: how pixels become Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import PositiveFloat, Range


@dataclass(frozen=True)
class SeedingOptions:
    """Creation of Gaussians from pixels."""

    radius: PositiveFloat = 0.6
    """Standard deviation of a new Gaussian, in pixels."""
    opacity: Annotated[float, Range(gt=0, lt=1)] = 0.95
    """Opacity of a new Gaussian."""
    max_cell: Literal[1, 2, 4, 8] = 8
    """Maximum side length in pixels of a block that becomes one Gaussian, where the surface has
    neither curvature nor texture beyond the differences between map and images. Blocks of more than
    2x2 pixels are at most 1/64 of the focal length wide."""
    choice: Literal["cells", "uniform", "semantic", "paper"] = "cells"
    """Selection of pixels: all, in blocks (cells), a random subset (uniform), a subset of which a
    class has a part in proportion to the square root of its area (semantic), or that of GauSem-SLAM
    as printed (paper): it does not pass on what small classes cannot use, nor does it enlarge the
    Gaussians in place of the other pixels."""
    share: Annotated[float, Range(gt=0, le=1)] = 0.5
    """Fraction of the pixels in a random subset (GauSem-SLAM: N_tot of the image area, 1)."""
