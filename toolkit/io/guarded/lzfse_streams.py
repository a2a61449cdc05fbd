"""Streams of LZFSE, unpacked into a buffer of limited size.

The package pyliblzfse repeats with twice the memory whatever does not fit, and also what is
damaged, until there is none left. It exports the decoder of Apple's library that it contains.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from types import ModuleType

import numpy as np

from toolkit.io.guarded.content import DamagedError, damage, size_text

# A depth image of 16 million pixels. Its memory is not used before it is filled.
_MAX_BYTES = 2**26
# What has no content, as it is written and in short.
_EMPTY = (b"bvx-\0\0\0\0bvx$", b"bvx$")


def decompressed(content: bytes, lzfse: ModuleType) -> bytes:
    """Unpack a stream.

    Args:
        content: the stream.
        lzfse: the module of the package pyliblzfse.

    Raises:
        DamagedError: it is damaged, or would be unpacked to more than 64 MB.
    """
    if content in _EMPTY:
        return b""
    decode = _decoder(lzfse.__file__ or "")
    if decode is None:
        with damage():
            return bytes(lzfse.decompress(content))
    unpacked = np.empty(_MAX_BYTES + 1, np.uint8)
    count = decode(unpacked.ctypes.data, unpacked.size, content, len(content), None)
    if not 0 < count <= _MAX_BYTES:
        raise DamagedError(f"it is no stream of LZFSE of at most {size_text(_MAX_BYTES)}")
    return unpacked[:count].tobytes()


@cache
def _decoder(file: str) -> Callable[..., int] | None:
    """`lzfse_decode_buffer(dst, dst_size, src, src_size, scratch)`; None if it is not exported."""
    decode = getattr(ctypes.CDLL(file), "lzfse_decode_buffer", None)
    if decode is not None:
        decode.restype = ctypes.c_size_t
        pointer, size = ctypes.c_void_p, ctypes.c_size_t
        decode.argtypes = [pointer, size, ctypes.c_char_p, size, pointer]
    return decode
