"""Images of numbers in OpenEXR files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError
from toolkit.io.guarded.content import check_regular
from toolkit.io.guarded.images import MAX_IMAGE_BYTES, check_pixels

# The size is among the first attributes, but notes may come before it.
_HEADER_BYTES = 2**20


def read_exr(file: Path, extra: str) -> NDArray:
    """Read the only channel [H, W] of an EXR file, or Z, Y or R of several ones.

    Args:
        file: the file.
        extra: the optional dependencies of semsplat that contain the reader, for the message.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged, or has too many pixels.
        DependencyError: the package that reads EXR is not installed.
    """
    try:
        import OpenEXR
    except ImportError as error:
        raise DependencyError(
            f"{file} needs a package that reads EXR: pip install 'semsplat[{extra}]'"
        ) from error
    check_regular(file, MAX_IMAGE_BYTES)
    with file.open("rb") as opened:
        check_pixels(opened.read(_HEADER_BYTES))
    try:
        with OpenEXR.File(str(file), separate_channels=True) as content:
            channels = {name: np.array(c.pixels) for name, c in content.channels().items()}
    except RuntimeError as error:
        raise ValueError(str(error)) from error
    for name in ("Z", "Y", "R"):
        if name in channels:
            return channels[name]
    return next(iter(channels.values()))
