"""Options of tracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import NonNegativeFloat, PositiveInt, Range


@dataclass(frozen=True)
class DenseOptions:
    """The dense tracker: Gauss-Newton alignment to the rendered map."""

    # Poses at 640x480 are as accurate when tracked at half that size, in half the time.
    max_width: Annotated[int, Range(ge=16)] = 480
    """Maximum image width for tracking, in pixels. Wider images are halved, as long as 320x240
    pixels or as many remain."""


@dataclass(frozen=True)
class FirstOrderOptions:
    """The papers' tracker: Adam on the camera pose."""

    preset: Literal["hier-slam", "gausem"] = "hier-slam"
    """Loss weights of Hier-SLAM (hier-slam) or GauSem (gausem)."""
    iterations: PositiveInt = 40
    """Number of Adam iterations per frame."""
    semantic: NonNegativeFloat | None = None
    """Weight of the semantic term, which needs labels; 0 disables it. By default, the preset's
    weight (hier-slam 0, gausem 0.5)."""


@dataclass(frozen=True)
class PlacementOptions:
    """Refinement of keyframe poses against earlier keyframes."""

    use: bool = True
    """Refine keyframe poses against earlier keyframes."""
    # Width 160 instead of 320 takes two fifths of the time. It costs 0.1 mm on a ring of rooms and
    # a quarter of a decibel in mapped views of fr1_rpy.
    max_width: Annotated[int, Range(ge=16)] = 400
    """Maximum image width for the alignment, in pixels. Wider images are halved."""
    # Above a floor that reflects 30 %, ATE fell from 0.197 to 0.162 cm (median of three rooms), but
    # mapped views of a HoloLens walk lost 1 dB. Weaker reflections are not found.
    ignore_reflections: bool = False
    """Ignore the colour of surfaces that look different from other directions, such as strongly
    reflecting floors."""


@dataclass(frozen=True)
class TrackingOptions:
    """Tracking."""

    kind: Literal["dense", "first-order"] = "dense"
    """Tracker: dense Gauss-Newton (dense) or the papers' Adam (first-order)."""
    detect_lost: bool = True
    """Detect frames whose alignment to the map is not reliable. Otherwise, every frame counts as
    tracked."""
    dense: DenseOptions = DenseOptions()
    first_order: FirstOrderOptions = FirstOrderOptions()
