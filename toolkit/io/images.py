"""Reading and writing of colour, depth and label images.

Decoders accept truncated images: the missing part of a JPEG becomes grey, the missing end of a
PNG is not reported, and warnings go to stderr only. The structure of a file is therefore checked
before decoding.
"""

from __future__ import annotations

import functools
import logging
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, DependencyError
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.atomic import write_bytes
from toolkit.io.guarded.content import DamagedError, check_regular, read_content
from toolkit.io.guarded.images import MAX_IMAGE_BYTES, MAX_PIXELS, check_pixels

PathLike = str | os.PathLike[str]

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_SCAN, _JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"
SATURATED_DEPTH = 65535
# Colour type of a PNG's header.
_PALETTE = b"\x03"

_log = logging.getLogger(__name__)


def read_rgb(path: PathLike, max_pixels: int = MAX_PIXELS) -> NDArray[np.float32]:
    """Read a colour image as [H, W, 3] float32 RGB in [0, 1].

    Greyscale images are converted to RGB; an alpha channel is dropped.

    Args:
        max_pixels: limit that is checked before decoding.

    Raises:
        DatasetError: the file is missing, truncated, corrupt, too large or not an image.
    """
    image = _read(Path(path), max_pixels)
    if image.dtype not in (np.uint8, np.uint16):
        raise DatasetError(
            f"{path} has {image.dtype} pixels; colour images must have 8 or 16 bits per channel"
        )
    if image.shape[2] < 3:
        image = np.repeat(image[..., :1], 3, axis=2)
    return np.divide(image[..., :3], np.float32(np.iinfo(image.dtype).max), dtype=np.float32)


def read_depth_m(path: PathLike, scale: float, max_pixels: int = MAX_PIXELS) -> NDArray[np.float32]:
    """Read a 16-bit depth PNG as [H, W] float32 metres, 0 where missing.

    Args:
        path: the image file; the values 0 and 65535 mark missing depth.
        scale: values per metre, > 0 (metres = value / scale).
        max_pixels: limit that is checked before decoding.

    Raises:
        DatasetError: the file is missing, truncated, corrupt, too large or not a 16-bit greyscale
            image.
    """
    raw = read_depth_values(path, max_pixels)
    depth_m = np.divide(raw, np.float32(scale), dtype=np.float32)
    depth_m[raw == SATURATED_DEPTH] = 0.0
    return depth_m


def read_depth_values(path: PathLike, max_pixels: int = MAX_PIXELS) -> NDArray[np.uint16]:
    """Read the values [H, W] of a 16-bit depth PNG.

    Raises:
        DatasetError: the file is missing, truncated, corrupt or not a 16-bit greyscale image.
    """
    raw = _read(Path(path), max_pixels)
    if raw.dtype != np.uint16 or raw.shape[2] != 1:
        raise DatasetError(
            f"{path} is not a depth image: {raw.shape[2]} channel(s) of {raw.dtype}; "
            f"save depth as a 16-bit PNG with one channel"
        )
    return raw[..., 0]


def read_labels(path: PathLike, max_pixels: int = MAX_PIXELS) -> NDArray[np.int32]:
    """Read a PNG of class ids as [H, W] int32: 8- or 16-bit greyscale, or the indices of a palette.

    Raises:
        DatasetError: the file is missing, truncated, corrupt or neither of these.
    """
    if _has_palette(Path(path)):
        return _palette_indices(Path(path), max_pixels)
    raw = _read(Path(path), max_pixels)
    if raw.dtype not in (np.uint8, np.uint16) or raw.shape[2] != 1:
        raise DatasetError(
            f"{path} is not a label image: {raw.shape[2]} channel(s) of {raw.dtype}; "
            f"save class ids as an 8- or 16-bit PNG with one channel, or as indices of a palette"
        )
    return raw[..., 0].astype(np.int32)


def _has_palette(path: Path) -> bool:
    """Whether a file is a PNG whose pixels are indices of a palette."""
    try:
        check_regular(path)
        with path.open("rb") as file:
            start = file.read(26)
    except (OSError, DamagedError):
        return False  # reading it reports why
    return start.startswith(_PNG_SIGNATURE) and start[25:26] == _PALETTE


def _palette_indices(path: Path, max_pixels: int) -> NDArray[np.int32]:
    """Read the indices, which the other decoders replace by the colours of the palette."""
    from PIL import Image, UnidentifiedImageError

    check_whole(path, max_pixels)
    try:
        with Image.open(path) as image:
            return np.asarray(image).astype(np.int32)
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise DatasetError(f"image {path} cannot be decoded ({error}); convert it again") from error


def write_rgb(path: PathLike, rgb: NDArray[np.floating]) -> None:
    """Write [H, W, 3] RGB in [0, 1] (clamped) with 8 bits per channel; the suffix sets the format.

    Raises:
        RunFolderError: the file cannot be written.
    """
    values = np.clip(np.asarray(rgb, dtype=np.float32), 0.0, 1.0) * 255.0
    _write(Path(path), cv2.cvtColor(np.rint(values).astype(np.uint8), cv2.COLOR_RGB2BGR))


def write_depth_png(path: PathLike, depth_m: NDArray[np.floating], scale: float) -> None:
    """Write [H, W] metres as a 16-bit PNG of round(depth * scale), 0 where missing.

    Depth beyond 65535 / scale metres is written as missing, because a clamped value would be
    wrong.

    Raises:
        RunFolderError: the file cannot be written.
    """
    values = np.rint(np.nan_to_num(np.asarray(depth_m, dtype=np.float64), posinf=0.0) * scale)
    values[(values < 0) | (values > SATURATED_DEPTH)] = 0
    _write(Path(path), values.astype(np.uint16))


def write_png(path: PathLike, image: NDArray[np.integer]) -> None:
    """Write [H, W] or [H, W, 3] (RGB) uint8 or uint16 values without conversion.

    Raises:
        ValueError: the dtype is neither uint8 nor uint16.
        RunFolderError: the file cannot be written.
    """
    write_bytes(Path(path), encode_png(image))


def encode_png(image: NDArray[np.integer]) -> bytes:
    """Return [H, W] or [H, W, 3] (RGB) uint8 or uint16 values as the bytes of a PNG.

    Raises:
        ValueError: the dtype is neither uint8 nor uint16.
    """
    if image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"PNG values must be uint8 or uint16, got {image.dtype}")
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    return cv2.imencode(".png", pixels)[1].tobytes()


def small_image(rgb: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Return an image [3, H, W] as [h, w, 3] with at most `width` columns."""
    image = np.ascontiguousarray(rgb.transpose(1, 2, 0))
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def check_whole(path: PathLike, max_pixels: int = MAX_PIXELS) -> None:
    """Check that an image file exists and is structurally complete, without decoding it.

    Raises:
        DatasetError: the file is missing, empty or truncated, or a PNG checksum does not match.
    """
    try:
        content = read_content(path, MAX_IMAGE_BYTES)
        check_pixels(content, max_pixels)
    except OSError as error:
        raise DatasetError(
            f"cannot read image {path}: {error.strerror}; check the path and its permissions"
        ) from error
    except DamagedError as error:
        raise DatasetError(f"image {path} cannot be used: {error}; convert it again") from error
    if content.startswith(_PNG_SIGNATURE):
        fault = _png_fault(content)
    elif content.startswith(_JPEG_START):
        # Within scan data 0xFF is always escaped, so an end marker after the last scan is valid.
        complete = content.rfind(_JPEG_END) > content.rfind(_JPEG_SCAN)
        fault = None if complete else "is truncated"
    else:
        fault = "is empty" if not content else "is neither PNG nor JPEG"
    if fault:
        raise DatasetError(f"image {path} {fault}; copy or convert it again, or remove the frame")


def _png_fault(content: bytes) -> str | None:
    """Return what is wrong with the chunks of a PNG, or None."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, position)
        end = position + 12 + length
        if end > len(content):
            break
        (checksum,) = struct.unpack_from(">I", content, end - 4)
        if zlib.crc32(content[position + 4 : end - 4]) != checksum:
            return "is corrupt (a checksum does not match)"
        if kind == b"IEND":
            return None
        position = end
    return "is truncated"


def _read(path: Path, max_pixels: int) -> NDArray:
    """Read the pixels [H, W, C] of an image file in RGB(A) order and the file's dtype."""
    check_whole(path, max_pixels)
    try:
        image = _decoder()(path)
    except RuntimeError as error:
        raise DatasetError(f"image {path} cannot be decoded ({error}); convert it again") from error
    if image.size == 0:
        raise DatasetError(f"image {path} cannot be decoded; copy or convert it again")
    return image


@functools.cache
def _decoder() -> Callable[[Path], NDArray]:
    """Return Open3D's image reader, or OpenCV's if Open3D cannot be loaded."""
    try:
        open3d()
    except DependencyError as error:
        _log.info("reading images with OpenCV: %s", error)
        return _read_with_opencv
    return _read_with_open3d


def _read_with_open3d(path: Path) -> NDArray:
    return np.asarray(open3d().t.io.read_image(str(path)).as_tensor().numpy())


def _read_with_opencv(path: Path) -> NDArray:
    """Read the same pixels with OpenCV; an empty array if decoding fails."""
    image = cv2.imread(os.fsencode(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return np.empty((0, 0, 1), np.uint8)
    if image.ndim == 2:
        return image[..., None]
    to_rgb = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cv2.cvtColor(image, to_rgb)


def _write(path: Path, image: NDArray) -> None:
    done, content = cv2.imencode(path.suffix or ".png", image)
    if not done:
        raise ValueError(f"OpenCV cannot encode {path.name}")
    write_bytes(path, content.tobytes())
