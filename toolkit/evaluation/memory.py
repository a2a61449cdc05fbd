"""Peak and present memory of this process."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")
_STATM = Path("/proc/self/statm")


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process in MB (10^6 bytes).

    On Linux, it is read from `VmHWM`: `getrusage` may report the memory of the parent process
    from which this one was forked.
    """
    if _STATUS.exists():
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return peak * bytes_per_unit / 1e6


def resident_memory_mb() -> float | None:
    """Return the present resident memory of this process in MB, None where it is unknown."""
    try:
        pages = int(_STATM.read_text().split()[1])
    except OSError:
        return None
    return pages * resource.getpagesize() / 1e6
