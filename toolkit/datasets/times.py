"""Whether the times of a recording are seconds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Decimal places of a second.
_UNITS = {"nanoseconds": 9, "microseconds": 6, "milliseconds": 3}
# Usual intervals of recordings. Longer ones are those of another unit, or of a time lapse, in which
# no camera is moved by hand.
_SHORTEST_S, _LONGEST_S = 1 / 250, 2.0
# No recording has such intervals, whatever was recorded.
_IMPOSSIBLE_S = 1e3


def unit_fault(times_s: NDArray[np.float64]) -> str:
    """Why the times of the frames [N] are not in seconds; empty if they may be."""
    steps = np.diff(times_s)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    usual = float(np.median(steps)) if len(steps) else 0.0
    if usual <= _LONGEST_S:
        return ""
    for unit, places in _UNITS.items():
        if _SHORTEST_S <= usual / 10**places <= _LONGEST_S:
            return (
                f"{usual:.3g} s between frames; the times look like {unit}: divide those of the "
                f"frames and of the trajectory by 1e{places}"
            )
    return f"{usual:.3g} s between frames; specify the times in seconds"


def is_impossible(times_s: NDArray[np.float64]) -> bool:
    """Whether the times [N] cannot be seconds, so that nothing that depends on them can work."""
    return len(times_s) > 1 and float(np.median(np.diff(times_s))) >= _IMPOSSIBLE_S
