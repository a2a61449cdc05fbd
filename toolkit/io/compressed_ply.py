"""Compressed splat PLYs, as SuperSplat and splat-transform read and write them.

Source: the source code of PlayCanvas (github.com/playcanvas/splat-transform). Positions, logarithms
of scales and colours are fractions of the ranges of chunks of 256 splats; harmonics have a byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.io.atomic import write_bytes
from toolkit.io.morton import morton_order
from toolkit.io.smallest_three import join_largest, split_largest
from toolkit.io.splat_columns import (
    CONSTANT_HARMONIC,
    Columns,
    Order,
    harmonics_of,
    logits,
    opacities_of,
)

Array = NDArray[np.float64]

_CHUNK = 256
_ENDS = ("min", "max")
# Comment of splats that were fitted with a filter of pixels that preserves opacity.
MIP_COMMENT = "SplatRenderMode: mip"
# Range of the harmonics.
_HARMONIC_RANGE = 8.0
# Bits of the parts of positions and scales, colours with opacities, and rotations.
_XYZ_BITS, _COLOUR_BITS, _ROTATION_BITS = (11, 10, 11), (8, 8, 8, 8), (10, 10, 10)


def unpacked_splats(path: Path, elements: Mapping[str, NDArray]) -> Columns:
    """Return positions, f_dc, f_rest, opacity (logit), scale (metres) and rot (wxyz).

    Args:
        path: the file, for messages.
        elements: its elements, of which `vertex` has packed splats.

    Raises:
        FormatError: the elements are not those of the format.
    """
    try:
        return _unpacked(elements)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise FormatError(
            f"{path}: the compressed splats cannot be read ({error!r}); write it again, or as an "
            "uncompressed .ply"
        ) from error


def _unpacked(elements: Mapping[str, NDArray]) -> Columns:
    chunks, rows = elements["chunk"], elements["vertex"]
    count = len(rows)
    if len(chunks) != -(-count // _CHUNK):
        raise ValueError(f"{len(chunks)} chunks for {count} splats")
    owner = np.arange(count) // _CHUNK

    def ranged(fractions: Array, names: str, prefix: str = "") -> Array:
        """Fractions [N, 3] of the ranges of the chunks."""
        low, high = (
            np.stack([chunks[f"{end}_{prefix}{name}"] for name in names], axis=1)[owner]
            for end in _ENDS
        )
        return np.asarray(low + fractions * (high.astype(np.float64) - low))

    colours = _fractions(rows["packed_color"], _COLOUR_BITS)
    rgb = colours[:, :3]
    if "min_r" in (chunks.dtype.names or ()):
        rgb = ranged(rgb, "rgb")
    columns = {
        "positions": ranged(_fractions(rows["packed_position"], _XYZ_BITS), "xyz"),
        "scale": np.exp(ranged(_fractions(rows["packed_scale"], _XYZ_BITS), "xyz", "scale_")),
        "rot": _rotations(rows["packed_rotation"]),
        "f_dc": (rgb - 0.5) / CONSTANT_HARMONIC,
        "opacity": logits(colours[:, 3]),
    }
    if "sh" in elements:
        harmonics = elements["sh"]
        width = len(harmonics.dtype.names or ())
        names = [f"f_rest_{k}" for k in range(width)]
        bytes_ = np.stack([harmonics[name] for name in names], axis=1).astype(np.float64)
        fractions = np.where(bytes_ == 255, 1.0, (bytes_ + 0.5) / 256) * (bytes_ > 0)
        # Red, then green, then blue.
        by_colour = (_HARMONIC_RANGE * (fractions - 0.5)).reshape(count, 3, width // 3)
        columns["f_rest"] = by_colour.transpose(0, 2, 1)
    return {name: np.ascontiguousarray(c, np.float32) for name, c in columns.items()}


def _fractions(packed: NDArray[np.uint32], bits: tuple[int, ...]) -> Array:
    """The parts [N, len(bits)] of packed integers, from the highest bits on, in [0, 1]."""
    parts, shift = [], sum(bits)
    for width in bits:
        shift -= width
        parts.append((packed >> np.uint32(shift) & (2**width - 1)) / (2**width - 1))
    return np.stack(parts, axis=1)


def _rotations(packed: NDArray[np.uint32]) -> Array:
    """Quaternions [N, 4]: the index of the largest entry, and the others in order."""
    largest = (packed >> np.uint32(30)).astype(np.int64)
    others = _fractions(packed & np.uint32(2**30 - 1), _ROTATION_BITS) - 0.5
    return join_largest(largest, others * 2**0.5)


def write_compressed_ply(path: Path, columns: Columns, is_filtered: bool = False) -> Order:
    """Write a compressed PLY, in Morton order, so that the ranges of the chunks are small.

    Args:
        path: the file.
        columns: the splats.
        is_filtered: whether they were fitted with a filter of pixels, as in Mip-Splatting.

    Raises:
        RunFolderError: the file cannot be written.
    """
    order = morton_order(columns["positions"])
    columns = {name: column[order] for name, column in columns.items()}
    largest, others = split_largest(columns["rot"])
    ranges = {
        "": columns["positions"].astype(np.float64),
        "scale_": np.log(columns["scale"].astype(np.float64)),
        "rgb": 0.5 + CONSTANT_HARMONIC * columns["f_dc"].astype(np.float64),
    }
    chunks, fractions = {}, {}
    for name, values in ranges.items():
        chunks[name], fractions[name] = _chunked(values)
    colours = np.column_stack([fractions["rgb"], opacities_of(columns)])
    rotations = _packed(others / 2**0.5 + 0.5, _ROTATION_BITS)
    rows = np.column_stack(
        [
            _packed(fractions[""], _XYZ_BITS),
            largest.astype(np.uint32) << np.uint32(30) | rotations,
            _packed(fractions["scale_"], _XYZ_BITS),
            _packed(colours, _COLOUR_BITS),
        ]
    )
    harmonics = harmonics_of(columns).transpose(0, 2, 1).reshape(len(order), -1)
    steps = np.floor((harmonics.astype(np.float64) / _HARMONIC_RANGE + 0.5) * 256.0)
    body = (
        np.concatenate(list(chunks.values()), axis=1).astype("<f4"),
        rows.astype("<u4"),
        steps.clip(0, 255).astype(np.uint8),
    )
    header = _header(len(order), harmonics.shape[1], is_filtered)
    write_bytes(path, header + b"".join(part.tobytes() for part in body))
    return order


def _header(count: int, harmonics: int, is_filtered: bool) -> bytes:
    axes = [f"{end}_{prefix}{axis}" for prefix in ("", "scale_") for end in _ENDS for axis in "xyz"]
    colours = [f"{end}_{colour}" for end in _ENDS for colour in "rgb"]
    packed = ("position", "rotation", "scale", "color")
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment {MIP_COMMENT}"] if is_filtered else []),
        f"element chunk {-(-count // _CHUNK)}",
        *(f"property float {name}" for name in axes + colours),
        f"element vertex {count}",
        *(f"property uint packed_{name}" for name in packed),
    ]
    if harmonics:
        lines.append(f"element sh {count}")
        lines += [f"property uchar f_rest_{k}" for k in range(harmonics)]
    return "\n".join([*lines, "end_header\n"]).encode()


def _chunked(values: Array) -> tuple[Array, Array]:
    """The ranges [C, 6] of chunks (minima, then maxima), and values [N, 3] as fractions of them."""
    starts = np.arange(0, len(values), _CHUNK)
    # The reader computes with ranges in single precision.
    low = np.minimum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    high = np.maximum.reduceat(values, starts).astype(np.float32).astype(np.float64)
    owner = np.arange(len(values)) // _CHUNK
    fractions = (values - low[owner]) / np.maximum(high - low, 1e-12)[owner]
    return np.concatenate([low, high], axis=1), fractions.clip(0.0, 1.0)


def _packed(fractions: Array, bits: tuple[int, ...]) -> NDArray[np.uint32]:
    """Integers [N] of fractions [N, len(bits)], the first in the highest bits."""
    packed = np.zeros(len(fractions), np.uint32)
    for column, width in enumerate(bits):
        steps = np.rint(fractions[:, column] * (2**width - 1)).clip(0, 2**width - 1)
        packed = packed << np.uint32(width) | steps.astype(np.uint32)
    return packed
