"""What libraries in C and C++ print to the streams of the process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

STDOUT, STDERR = 1, 2


@contextmanager
def diverted(streams: Sequence[int], target: int) -> Iterator[None]:
    """Send streams of the process to a file; other threads must not write to them meanwhile.

    Args:
        streams: STDOUT, STDERR or both. Services may have closed theirs.
        target: descriptor of the file.
    """
    kept = {}
    for number in streams:
        with suppress(OSError, AttributeError):
            (sys.stdout if number == STDOUT else sys.stderr).flush()
            kept[number] = os.dup(number)
    try:
        for number in kept:
            os.dup2(target, number)
        yield
    finally:
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)


@contextmanager
def silenced() -> Iterator[None]:
    """Discard what libraries print to stdout and stderr of the process."""
    with Path(os.devnull).open("wb") as nowhere, diverted((STDOUT, STDERR), nowhere.fileno()):
        yield
