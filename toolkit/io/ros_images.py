"""Decoding of the image messages of ROS: `sensor_msgs` Image and CompressedImage.

Encodings are those of `sensor_msgs/image_encodings.h` and of `image_transport`'s plugins
`compressed_image_transport` and `compressed_depth_image_transport`; 16-bit depth counts millimetres
and 32-bit depth metres (REP 118).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.io.guarded.images import decoded

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

_DEPTH_ENCODINGS = ("16UC1", "32FC1")
# Of 16 bits, without a statement of what they mean: depth of a RealSense, or intensities.
_MONO16 = "mono16"
# Header of compressed depth: an enumeration, and the two parameters of quantised inverse depth.
_DEPTH_HEADER = struct.Struct("<iff")


@dataclass(frozen=True)
class _Encoding:
    """Pixels of an encoding, and OpenCV's conversion of them to RGB; None if they are grey."""

    dtype: str
    channels: int
    to_rgb: int | None


_COLOUR_ENCODINGS = {
    "rgb8": _Encoding("u1", 3, -1),
    "8UC3": _Encoding("u1", 3, cv2.COLOR_BGR2RGB),
    "bgr8": _Encoding("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": _Encoding("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": _Encoding("u1", 4, cv2.COLOR_BGRA2RGB),
    "8UC4": _Encoding("u1", 4, cv2.COLOR_BGRA2RGB),
    "rgb16": _Encoding("u2", 3, -1),
    "bgr16": _Encoding("u2", 3, cv2.COLOR_BGR2RGB),
    "mono8": _Encoding("u1", 1, None),
    "8UC1": _Encoding("u1", 1, None),
    "mono16": _Encoding("u2", 1, None),
    "yuv422": _Encoding("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": _Encoding("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": _Encoding("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": _Encoding("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": _Encoding("u1", 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": _Encoding("u1", 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": _Encoding("u1", 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": _Encoding("u1", 1, cv2.COLOR_BayerGRBG2RGB),
}


def encoding_of(message: Any) -> str:
    """Encoding of an image, for instance "rgb8"; of a compressed one, "jpeg" if it has no other."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    return str(message.format).split(";")[0].strip()


def is_depth(topic: str, message: Any) -> bool:
    """Whether images of a topic are depth, judged by one of its messages."""
    encoding = encoding_of(message)
    if "compressedDepth" in str(getattr(message, "format", "")) or encoding in _DEPTH_ENCODINGS:
        return True
    return encoding == _MONO16 and "depth" in topic.lower()


def is_grey(message: Any) -> bool:
    """Whether images without depth have one channel."""
    pixels = _COLOUR_ENCODINGS.get(encoding_of(message))
    if pixels is not None:
        return pixels.to_rgb is None
    return hasattr(message, "format") and _decoded(message).ndim == 2


def size_of(message: Any) -> tuple[int, int]:
    """Width and height of an image."""
    if hasattr(message, "encoding"):
        return int(message.width), int(message.height)
    skipped = _DEPTH_HEADER.size if "compressedDepth" in str(message.format) else 0
    height, width = _decoded(message, skipped).shape[:2]
    return width, height


def colour_of(message: Any) -> NDArray[np.float32]:
    """Decode an image as [H, W, 3] float32 RGB in [0, 1].

    Raises:
        DatasetError: the encoding is not supported, or the image is damaged.
    """
    if hasattr(message, "encoding"):
        encoding = encoding_of(message)
        pixels = _COLOUR_ENCODINGS.get(encoding)
        if pixels is None:
            raise DatasetError(
                f"images have the encoding {encoding}, which is not supported; convert them to rgb8"
            )
        image = _array(message, pixels.dtype, pixels.channels)
        if pixels.to_rgb is None:
            image = np.repeat(image, 3, axis=2)
        elif pixels.to_rgb >= 0:
            image = cv2.cvtColor(image, pixels.to_rgb)
    else:
        image = _decoded(message)
        image = image[..., None] if image.ndim == 2 else image[..., 2::-1]
        image = np.broadcast_to(image, (*image.shape[:2], 3))
    return np.ascontiguousarray(image, np.float32) / np.float32(np.iinfo(image.dtype).max)


def depth_m_of(message: Any, metres_per_value: float) -> NDArray[np.float32]:
    """Decode a depth image as [H, W] float32 metres, 0 where missing.

    Args:
        metres_per_value: unit of integer images.

    Raises:
        DatasetError: the encoding is not supported, or the image is damaged.
    """
    if hasattr(message, "encoding"):
        dtype = "f4" if encoding_of(message) == "32FC1" else "u2"
        image = _array(message, dtype, 1)[..., 0]
    elif "compressedDepth" in str(message.format):
        image = _decompressed_depth(message)
    else:
        image = _decoded(message)
    if image.ndim != 2 or image.dtype not in (np.uint16, np.float32):
        raise DatasetError("depth images must have one channel of 16 or 32 bits; record raw depth")
    if image.dtype == np.uint16:
        return image.astype(np.float32) * np.float32(metres_per_value)
    known = np.isfinite(image) & (image > 0)
    return np.where(known, image, np.float32(0.0)).astype(np.float32)


def _array(message: Any, dtype: str, channels: int) -> NDArray:
    """Pixels [H, W, channels]; rows may be padded."""
    order = ">" if message.is_bigendian else "<"
    width, height, step = int(message.width), int(message.height), int(message.step)
    used = width * channels * np.dtype(dtype).itemsize
    data = np.asarray(message.data, np.uint8)
    if step < used or data.size < step * height:
        raise DatasetError(f"an image of {width}x{height} pixels is truncated; record it again")
    rows = data[: step * height].reshape(height, step)[:, :used]
    pixels = np.ascontiguousarray(rows).view(order + dtype).reshape(height, width, channels)
    return pixels.astype(dtype)


def _decoded(message: Any, skipped_bytes: int = 0) -> NDArray:
    """Pixels [H, W] or [H, W, 3] BGR of a compressed image."""
    data = np.asarray(message.data, np.uint8)[skipped_bytes:]
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        return decoded(data, flags)
    except ValueError as error:
        raise DatasetError(
            f"an image in the format {message.format!r} cannot be decoded ({error}); record JPEG, "
            "PNG or raw images"
        ) from error


def _decompressed_depth(message: Any) -> NDArray:
    """Integers, or metres from inverse depth, which the PNG contains for 32-bit depth."""
    if np.asarray(message.data).size <= _DEPTH_HEADER.size:
        raise DatasetError("a compressed depth image is truncated; record it again")
    _, scale, offset = _DEPTH_HEADER.unpack_from(bytes(message.data[: _DEPTH_HEADER.size]))
    values = _decoded(message, _DEPTH_HEADER.size)
    if encoding_of(message) != "32FC1":
        return values
    difference = values.astype(np.float32) - offset
    known = (values > 0) & (difference > 0)
    return np.where(known, scale / np.where(known, difference, 1.0), 0.0).astype(np.float32)
