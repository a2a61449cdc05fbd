"""Read SOG, the format of PlayCanvas: `meta.json` and lossless WebP images, also zipped (`.sog`).

Source: developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, and for version 1 the
source code of github.com/playcanvas/splat-transform. A pixel belongs to a splat, row by row.
Version 2 stores scales, colours and harmonics as indices into codebooks of 256 values; version 1 as
fractions of a range. Axes are those of a PLY.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.guarded.archive import Archive
from toolkit.io.guarded.content import DamagedError, read_content
from toolkit.io.guarded.documents import parse_json
from toolkit.io.smallest_three import join_largest
from toolkit.io.splat_columns import Columns, check_count, logits

META = "meta.json"
# The last byte of a rotation is this plus the index of the largest of w, x, y, z.
FIRST_ROTATION_TAG = 252
# Entries of the palette of harmonics in a row of its image.
PALETTE_COLUMNS = 64
# Value of the key `model` if splats were fitted with a filter of pixels, as in Mip-Splatting.
FILTERED_MODEL = "antialiased"
_CODEBOOK = 256
# Images may be larger than their splats need, and that of the palette has up to a million pixels.
_PIXELS, _PIXELS_PER_SPLAT = 2**22, 4
# Large members of a bundle are unpacked to at most this factor: images are compressed.
_EXPANSION = 20

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


def read_sog(path: Path) -> Columns:
    """Read a `.sog` bundle, or a `meta.json` with its images beside it.

    Raises:
        FormatError: an image or key is missing or damaged, or the version is not supported.
    """
    try:
        if path.suffix.lower() == ".json":
            return _columns(path, _json(read_content(path)), lambda name: _beside(path, name))
        with Archive(path) as bundle:
            return _columns(path, _json(_member(bundle, META)), lambda name: _member(bundle, name))
    except DamagedError as error:
        raise _cannot_read(path, str(error)) from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise _cannot_read(path, f"{META} or an image is not as it must be: {error!r}") from error
    except (OSError, EOFError) as error:
        raise _cannot_read(path, f"an image or {META} is missing or damaged: {error}") from error


def is_filtered_sog(path: Path) -> bool:
    """Whether a file that `read_sog` has read says that its splats were fitted with a filter."""
    if path.suffix.lower() == ".json":
        return _json(read_content(path)).get("model") == FILTERED_MODEL
    with Archive(path) as bundle:
        return _json(bundle.read(META)).get("model") == FILTERED_MODEL


def _cannot_read(path: Path, reason: str) -> FormatError:
    return FormatError(f"{path} cannot be read ({reason}); write it again, or as a .ply")


def _json(content: bytes) -> dict[str, Any]:
    meta = parse_json(content)
    if not isinstance(meta, dict) or "means" not in meta:
        raise DamagedError(f"{META} does not describe splats")
    if meta.get("version", 1) not in (1, 2):
        raise DamagedError(f"version {meta['version']} is not 1 or 2")
    return meta


def _member(bundle: Archive, name: str) -> bytes:
    return bundle.read(name, max_ratio=_EXPANSION)


def _beside(path: Path, name: str) -> bytes:
    if Path(name).name != name or "\\" in name:
        raise DamagedError(f"{name!r} is not the name of a file beside it")
    return read_content(path.parent / name)


def _columns(path: Path, meta: dict[str, Any], read: Callable[[str], bytes]) -> Columns:
    is_old = "version" not in meta or meta["version"] == 1
    count = int(meta["means"]["shape"][0] if is_old else meta["count"])
    # Positions can be compressed least.
    check_count(path, count, len(read(meta["means"]["files"][0])))

    def image(part: str, index: int = 0) -> Image:
        name = meta[part]["files"][index]
        return _decoded(name, read(name), _PIXELS + _PIXELS_PER_SPLAT * count)

    def pixels(part: str, index: int = 0) -> Image:
        rows, name = image(part, index).reshape(-1, 4), meta[part]["files"][index]
        if len(rows) < count:
            raise DamagedError(f"{name} has {len(rows)} pixels for {count} splats")
        return rows[:count]

    scales, colours = pixels("scales"), pixels("sh0")
    if is_old:
        log_scales = _between(meta["scales"], scales[:, :3] / 255.0)
        f_dc = _between(meta["sh0"], colours / 255.0)
        opacity = f_dc[:, 3:].astype(np.float32)
    else:
        log_scales = _coded(meta["scales"], scales[:, :3])
        f_dc = _coded(meta["sh0"], colours[:, :3])
        opacity = logits(colours[:, 3] / 255.0)
    fractions = (pixels("means")[:, :3] + 256.0 * pixels("means", 1)[:, :3]) / 65535.0
    means = _between(meta["means"], fractions)
    columns = {
        "positions": np.sign(means) * np.expm1(np.abs(means)),
        "scale": np.exp(log_scales),
        "rot": _rotations(pixels("quats")),
        "f_dc": f_dc[:, :3],
        "opacity": opacity,
    }
    if "shN" in meta:
        labels = pixels("shN", 1).astype(np.int64)
        columns["f_rest"] = _harmonics(meta["shN"], image("shN"))[labels[:, 0] + 256 * labels[:, 1]]
    return {name: np.ascontiguousarray(c, np.float32) for name, c in columns.items()}


def _decoded(name: str, content: bytes, max_pixels: int) -> Image:
    """The pixels [H, W, 4] of an image."""
    from PIL import Image as Images

    try:
        with warnings.catch_warnings():
            # The limit is checked here.
            warnings.simplefilter("ignore", Images.DecompressionBombWarning)
            image = Images.open(io.BytesIO(content), formats=["WEBP", "PNG"])
        if image.width * image.height > max_pixels:
            raise DamagedError(f"{name} has {image.width}x{image.height} pixels")
        return np.asarray(image.convert("RGBA"))
    except DamagedError:
        raise
    except (OSError, ValueError, SyntaxError, Images.DecompressionBombError) as error:
        raise DamagedError(f"{name} is not a whole WebP or PNG image") from error


def _between(part: dict[str, Any], fractions: Array) -> Array:
    """Fractions [N, K] of the range of each column."""
    width = fractions.shape[1]
    low, high = (np.asarray(part[end], np.float64).reshape(width) for end in ("mins", "maxs"))
    return np.asarray(low + fractions * (high - low))


def _coded(part: dict[str, Any], codes: Image) -> Array:
    codebook = np.asarray(part["codebook"], np.float64).reshape(-1)
    if len(codebook) > _CODEBOOK:
        raise DamagedError(f"a codebook has {len(codebook)} values instead of {_CODEBOOK}")
    return np.asarray(codebook[codes])


def _rotations(pixels: Image) -> Array:
    others = (pixels[:, :3] / 255.0 * 2.0 - 1.0) / 2.0**0.5
    largest = pixels[:, 3].astype(np.int64) - FIRST_ROTATION_TAG
    joined = join_largest(largest.clip(0), others)
    joined[largest < 0] = (1, 0, 0, 0)
    return joined


def _harmonics(part: dict[str, Any], image: Image) -> Array:
    """The palette [P, K, 3] of harmonics."""
    count = image.shape[1] // PALETTE_COLUMNS
    if image.shape[1] % PALETTE_COLUMNS or count not in HARMONIC_COUNTS[1:]:
        raise DamagedError(f"the palette of harmonics is {image.shape[1]} pixels wide")
    palette = image[..., :3].reshape(-1, count, 3)
    if "codebook" in part:
        return _coded(part, palette)
    low, high = float(part["mins"]), float(part["maxs"])
    return np.asarray(low + palette / 255.0 * (high - low))
