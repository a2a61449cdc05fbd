"""Options of pose graphs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import Range

Kernel = Literal["none", "huber", "cauchy", "geman-mcclure"]


@dataclass(frozen=True)
class PoseGraphOptions:
    """Pose graphs of submaps and of keyframes: which loops are kept, and their robust kernel."""

    confidence: Annotated[float, Range(gt=0, le=1)] = 0.999
    """Fraction of correct loops that pass each test: against the odometry, against each other, and
    against the optimised graph."""
    kernel: Kernel = "cauchy"
    """Robust kernel of loop edges."""
