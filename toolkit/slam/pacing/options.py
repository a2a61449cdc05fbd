"""Options of real-time operation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from toolkit.base.options import Range

# Higher rates than those of cameras are useful to measure overload.
FramesPerSecond = Annotated[float, Range(ge=0, le=1000)]


@dataclass(frozen=True)
class PacingOptions:
    """How a run with --pace keeps up with the camera."""

    max_delay_s: Annotated[float, Range(gt=0, le=60)] = 0.4
    """Maximum time from the arrival of a frame to its pose, in seconds. Keyframes are postponed
    and frames are dropped where it would be exceeded."""
