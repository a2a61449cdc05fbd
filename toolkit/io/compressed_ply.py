"""Read compressed splat PLYs, as SuperSplat and splat-transform write them.

Source: the source code of PlayCanvas (github.com/playcanvas/splat-transform). Positions, logarithms
of scales and colours are fractions of the ranges of chunks of 256 splats; harmonics have a byte.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError

Array = NDArray[np.float64]
Columns = dict[str, NDArray[np.float32]]

# The value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
_CONSTANT_HARMONIC = 0.28209479
_CHUNK = 256
_TYPES = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
# Range of the harmonics.
_HARMONIC_RANGE = 8.0


def is_compressed_ply(path: Path) -> bool:
    """Whether the header of a PLY describes packed splats."""
    with path.open("rb") as file:
        return b"packed_position" in file.read(4096).partition(b"end_header")[0]


def read_compressed_ply(path: Path) -> Columns:
    """Return positions, f_dc, f_rest, opacity (logit), scale (metres) and rot (wxyz).

    Raises:
        FormatError: the file is truncated, or its header is not that of the format.
    """
    elements = _elements(path, path.read_bytes())
    try:
        return _unpacked(elements)
    except (KeyError, ValueError, IndexError) as error:
        raise FormatError(
            f"{path}: the compressed splats cannot be read ({error!r}); write it again, or as an "
            "uncompressed .ply"
        ) from error


def _elements(path: Path, content: bytes) -> dict[str, NDArray]:
    """The rows of each element by its name."""
    header, end, body = content.partition(b"end_header\n")
    layouts: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    name = ""
    for line in header.decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            name = words[1]
            layouts[name] = int(words[2]), []
        elif words[:1] == ["property"] and len(words) == 3 and name and words[1] in _TYPES:
            layouts[name][1].append((words[2], _TYPES[words[1]]))
    elements, place = {}, 0
    for name, (count, fields) in layouts.items():
        dtype = np.dtype(fields)
        if not end or len(body) < place + count * dtype.itemsize:
            raise FormatError(f"{path} is truncated: its {name}s are incomplete; write it again")
        elements[name] = np.frombuffer(body, dtype, count, place)
        place += count * dtype.itemsize
    return elements


def _unpacked(elements: dict[str, NDArray]) -> Columns:
    chunks, rows = elements["chunk"], elements["vertex"]
    count = len(rows)
    if len(chunks) != -(-count // _CHUNK):
        raise ValueError(f"{len(chunks)} chunks for {count} splats")
    owner = np.arange(count) // _CHUNK

    def ranged(fractions: Array, names: str, prefix: str = "") -> Array:
        """Fractions [N, 3] of the ranges of the chunks."""
        low, high = (
            np.stack([chunks[f"{end}_{prefix}{name}"] for name in names], axis=1)[owner]
            for end in ("min", "max")
        )
        return np.asarray(low + fractions * (high.astype(np.float64) - low))

    colours = _fractions(rows["packed_color"], (8, 8, 8, 8))
    rgb, opacity = colours[:, :3], colours[:, 3].clip(1e-6, 1 - 1e-6)
    if "min_r" in (chunks.dtype.names or ()):
        rgb = ranged(rgb, "rgb")
    columns = {
        "positions": ranged(_fractions(rows["packed_position"], (11, 10, 11)), "xyz"),
        "scale": np.exp(ranged(_fractions(rows["packed_scale"], (11, 10, 11)), "xyz", "scale_")),
        "rot": _rotations(rows["packed_rotation"]),
        "f_dc": (rgb - 0.5) / _CONSTANT_HARMONIC,
        "opacity": np.log(opacity / (1.0 - opacity))[:, None],
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
    others = (_fractions(packed & np.uint32(2**30 - 1), (10, 10, 10)) - 0.5) * 2**0.5
    last = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=1), 0.0))
    place = np.arange(4) - (np.arange(4) > largest[:, None])
    found = np.take_along_axis(others, np.minimum(place, 2), axis=1)
    found[np.arange(len(packed)), largest] = last
    return np.asarray(found)
