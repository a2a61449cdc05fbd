"""Hear what the JPEG decoder only mutters on stderr.

A JPEG whose body was damaged still decodes, to wrong colours, and libjpeg tells nobody but
the process's error stream. PNGs carry checksums and need none of this.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import cv2


def decoder_warning(path: Path) -> str:
    """What the decoder says about a JPEG file; empty where it is sound, or no JPEG.

    The process's stderr is diverted for the moment: for programs that check data, not for
    threads beside others that log.
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
