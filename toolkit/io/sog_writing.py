"""Write `.sog` bundles of version 2; see `sog` for the format."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.atomic import write_bytes
from toolkit.io.morton import morton_order
from toolkit.io.quantisation import codebook, nearest_codes, palette
from toolkit.io.smallest_three import split_largest
from toolkit.io.sog import FILTERED_MODEL, FIRST_ROTATION_TAG, META, PALETTE_COLUMNS
from toolkit.io.splat_columns import Columns, Order, harmonics_of, opacities_of

_VERSION = 2
# Width and height of images are multiples of this.
_BLOCK = 4
# The palette has a power of two times this many entries, at most 65,536.
_PALETTE_UNIT, _MAX_PALETTE_UNITS = 1024, 64

Part = dict[str, Any]
Files = dict[str, bytes]


def write_sog(path: Path, columns: Columns, is_filtered: bool = False) -> Order:
    """Write a `.sog` file, sorted in Morton order, which compresses better.

    Args:
        path: the file.
        columns: the splats.
        is_filtered: whether they were fitted with a filter of pixels, as in Mip-Splatting.

    Raises:
        RunFolderError: the file cannot be written.
    """
    order = morton_order(columns["positions"])
    columns = {name: column[order] for name, column in columns.items()}
    meta: Part = {
        "version": _VERSION,
        "asset": {"generator": "semsplat"},
        "count": len(order),
    }
    if is_filtered:
        meta["model"] = FILTERED_MODEL
    files: Files = {}
    for name, write in (
        ("means", _means),
        ("scales", _scales),
        ("quats", _rotations),
        ("sh0", _colours),
        ("shN", _harmonics),
    ):
        part, images = write(columns)
        if images:
            meta[name] = part | {"files": list(images)}
            files |= images
    write_bytes(path, _zip(files | {META: json.dumps(meta).encode()}))
    return order


def _means(columns: Columns) -> tuple[Part, Files]:
    """Positions as 16 bits of the range of sign(x) log(1 + |x|), in two images."""
    means = columns["positions"].astype(np.float64)
    logarithms = np.sign(means) * np.log1p(np.abs(means))
    low, high = logarithms.min(axis=0), logarithms.max(axis=0)
    fractions = (logarithms - low) / np.maximum(high - low, 1e-12)
    steps = np.rint(65535.0 * fractions).astype(np.uint16)
    files = {"means_l.webp": _image(steps & 255), "means_u.webp": _image(steps >> 8)}
    return {"mins": low.tolist(), "maxs": high.tolist()}, files


def _scales(columns: Columns) -> tuple[Part, Files]:
    log_scales = np.log(columns["scale"].astype(np.float64))
    codes = codebook(log_scales)
    return {"codebook": codes.tolist()}, {"scales.webp": _image(nearest_codes(log_scales, codes))}


def _rotations(columns: Columns) -> tuple[Part, Files]:
    largest, others = split_largest(columns["rot"])
    bytes_ = np.rint(255.0 * (0.5 + others / 2.0**0.5)).clip(0, 255)
    tagged = np.column_stack([bytes_, FIRST_ROTATION_TAG + largest])
    return {}, {"quats.webp": _image(tagged)}


def _colours(columns: Columns) -> tuple[Part, Files]:
    f_dc = columns["f_dc"].astype(np.float64)
    codes = codebook(f_dc)
    opacities = np.rint(255.0 * opacities_of(columns))
    pixels = np.column_stack([nearest_codes(f_dc, codes), opacities])
    return {"codebook": codes.tolist()}, {"sh0.webp": _image(pixels)}


def _harmonics(columns: Columns) -> tuple[Part, Files]:
    harmonics = harmonics_of(columns)
    count, width = harmonics.shape[:2]
    if not harmonics.any():
        return {}, {}
    units = min(_MAX_PALETTE_UNITS, 2 ** int(math.log2(max(count / _PALETTE_UNIT, 1))))
    entries, labels = palette(harmonics.reshape(count, -1), units * _PALETTE_UNIT)
    codes = codebook(entries)
    rows = -(-len(entries) // PALETTE_COLUMNS)
    pixels = np.zeros((rows * PALETTE_COLUMNS, width, 3), np.uint8)
    pixels[: len(entries)] = nearest_codes(entries, codes).reshape(-1, width, 3)
    shape = rows, PALETTE_COLUMNS * width
    files = {
        "shN_centroids.webp": _webp(_opaque(pixels.reshape(-1, 3)).reshape(*shape, 4)),
        "shN_labels.webp": _image(np.column_stack([labels & 255, labels >> 8, 0 * labels])),
    }
    part = {
        "count": len(entries),
        "bands": HARMONIC_COUNTS.index(width),
        "codebook": codes.tolist(),
    }
    return part, files


def _image(values: NDArray) -> bytes:
    """A WebP of bytes [N, 3] or [N, 4], row by row; the rest of the last rows is 0."""
    count = len(values)
    width = math.ceil(math.sqrt(count) / _BLOCK) * _BLOCK
    height = math.ceil(count / width / _BLOCK) * _BLOCK
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:count] = values if values.shape[1] == 4 else _opaque(values)
    return _webp(pixels.reshape(height, width, 4))


def _opaque(values: NDArray) -> NDArray[np.uint8]:
    return np.column_stack([values, np.full(len(values), 255)]).astype(np.uint8)


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    """A lossless WebP of pixels [H, W, 4]; OpenCV changes the colours of transparent ones."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(file, "WEBP", lossless=True, exact=True, quality=75)
    return file.getvalue()


def _zip(files: Files) -> bytes:
    """A zip of files that are compressed already, without times, so that it is reproducible."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in files.items():
            bundle.writestr(zipfile.ZipInfo(name), data)
    return content.getvalue()
