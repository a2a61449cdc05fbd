"""Capture warnings that the JPEG decoder prints to stderr.

A damaged JPEG decodes to wrong colours without an error; libjpeg only prints a warning to
stderr. PNGs contain checksums, so this is not needed for them.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import cv2


def decoder_warning(path: Path) -> str:
    """Return the decoder's warnings about a file; empty if it is intact or not a JPEG.

    The stderr of the process is redirected meanwhile, so this must not be called while other
    threads write to it.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return ""
    sys.stderr.flush()
    stderr = os.dup(2)
    with tempfile.TemporaryFile() as diverted:
        os.dup2(diverted.fileno(), 2)
        try:
            cv2.imread(str(path), cv2.IMREAD_COLOR)
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        diverted.seek(0)
        return diverted.read().decode("utf-8", "replace").strip()
