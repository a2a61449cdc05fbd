"""Images of other people: a header of a few bytes cannot use all memory."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from toolkit.io.exr import read_exr
from toolkit.io.guarded.content import DamagedError
from toolkit.io.guarded.images import check_pixels, decoded, image_size

IMAGE = np.zeros((30, 50, 3), np.uint8)


def png_header(width: int, height: int) -> bytes:
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    crc = struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + crc


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_the_size_is_that_of_the_image(suffix: str):
    content = cv2.imencode(suffix, IMAGE)[1].tobytes()
    assert image_size(content) == (50, 30)
    assert decoded(content, cv2.IMREAD_COLOR).shape == (30, 50, 3)


def test_a_jpeg_with_a_long_note_and_padding():
    content = cv2.imencode(".jpg", IMAGE)[1].tobytes()
    note = b"\xff\xe1" + struct.pack(">H", 2 + 60_000) + b"\xff\xd8\xff\xc0" * 15_000
    assert image_size(content[:2] + note + b"\xff" + content[2:]) == (50, 30)


def test_large_images_are_not_decoded():
    with pytest.raises(DamagedError, match="60000x60000 pixels"):
        decoded(png_header(60_000, 60_000), cv2.IMREAD_COLOR)
    jpeg = bytearray(cv2.imencode(".jpg", IMAGE)[1].tobytes())
    at = jpeg.index(b"\xff\xc0") + 5
    jpeg[at : at + 4] = struct.pack(">HH", 60_000, 60_000)
    with pytest.raises(DamagedError, match="60000x60000 pixels"):
        decoded(bytes(jpeg), cv2.IMREAD_COLOR)
    check_pixels(png_header(8192, 8192))


@pytest.mark.parametrize(
    "content", [b"", b"text", b"\xff\xd8\xff", b"\xff\xd8\xff\xe0\x00\x00" * 9]
)
def test_what_is_no_image(content: bytes):
    assert image_size(content) is None
    with pytest.raises(DamagedError, match="no image"):
        decoded(content, cv2.IMREAD_COLOR)


def test_the_size_of_an_exr_is_that_of_its_data_window(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    file = tmp_path / "depth.exr"
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, {"R": np.ones((30, 50), np.float32)}).write(str(file))
    content = file.read_bytes()
    assert image_size(content) == (50, 30)
    assert read_exr(file, "record3d").shape == (30, 50)
    place = content.find(b"dataWindow") + 21
    file.write_bytes(
        content[: place + 8] + struct.pack("<ii", 60_000, 60_000) + content[place + 16 :]
    )
    with pytest.raises(DamagedError, match="60001x60001 pixels"):
        read_exr(file, "record3d")
