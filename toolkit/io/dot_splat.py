"""`.splat` files: 32 bytes per splat without a header.

Source: github.com/antimatter15/splat. Position and scale are floats; colour, opacity and rotation
(wxyz) have a byte per value. There are no harmonics.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.base.errors import FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.guarded.content import read_content
from toolkit.io.splat_columns import CONSTANT_HARMONIC, Columns, Order, logits, opacities_of

_ROW = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)


def read_dot_splat(path: Path) -> Columns:
    """Read a `.splat` file.

    Raises:
        FormatError: its length is not a multiple of 32 bytes.
    """
    content = read_content(path)
    if not content or len(content) % _ROW.itemsize:
        raise FormatError(
            f"{path} is truncated, or not a .splat file: its length of {len(content)} bytes is not "
            f"a multiple of {_ROW.itemsize}; write it again"
        )
    rows = np.frombuffer(content, _ROW)
    return {
        "positions": rows["position"].copy(),
        "scale": rows["scale"].copy(),
        "f_dc": ((rows["rgba"][:, :3] / 255.0 - 0.5) / CONSTANT_HARMONIC).astype(np.float32),
        "opacity": logits(rows["rgba"][:, 3] / 255.0),
        "rot": (rows["rotation"].astype(np.float32) - 128.0) / 128.0,
    }


def write_dot_splat(path: Path, columns: Columns) -> Order:
    """Write a `.splat` file: large opaque splats first, since viewers show parts of it early.

    Raises:
        RunFolderError: the file cannot be written.
    """
    opacities = opacities_of(columns)
    volumes = columns["scale"].astype(np.float64).prod(axis=1)
    order = np.argsort(-volumes * opacities, kind="stable")
    rows = np.zeros(len(order), _ROW)
    rows["position"], rows["scale"] = columns["positions"][order], columns["scale"][order]
    colours = 0.5 + CONSTANT_HARMONIC * columns["f_dc"][order].astype(np.float64)
    rows["rgba"][:, :3] = np.rint(255.0 * colours.clip(0.0, 1.0))
    rows["rgba"][:, 3] = np.rint(255.0 * opacities[order])
    rows["rotation"] = np.rint(128.0 * columns["rot"][order] + 128.0).clip(0, 255)
    write_bytes(path, rows.tobytes())
    return order
