"""Settings of the C library's memory allocator."""

from __future__ import annotations

import ctypes
import functools
import sys

# Parameters of mallopt in glibc, and their values in bytes: the images of a rendering of
# 1920x1080 pixels with eight feature channels have 170 MB.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_LARGEST_REUSED, _LARGEST_KEPT = 2**28, 2**29


@functools.cache
def reuse_freed_memory() -> None:
    """Let the process reuse the memory of large images; without effect outside of glibc.

    By default, glibc returns blocks of more than 32 MB to the system when they are freed. The
    images of every rendering of more than about 1000x600 pixels would then be mapped, filled with
    zeros by the kernel and unmapped again, which takes a sixth of the time of an optimisation step.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST_REUSED)
        mallopt(_TRIM_THRESHOLD, _LARGEST_KEPT)
