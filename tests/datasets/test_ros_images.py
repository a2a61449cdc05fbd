"""Decoding of ROS image messages."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from toolkit.base.errors import DatasetError
from toolkit.io.ros_images import colour_of, depth_m_of, is_depth, is_grey, size_of

RED = (200, 40, 90)  # a colour whose channels all differ


def raw(pixels: np.ndarray, encoding: str, big_endian: bool = False) -> SimpleNamespace:
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    return SimpleNamespace(
        encoding=encoding,
        width=width,
        height=height,
        step=data.shape[1],
        is_bigendian=int(big_endian),
        data=data.ravel(),
    )


def compressed(data: bytes, form: str) -> SimpleNamespace:
    return SimpleNamespace(format=form, data=np.frombuffer(data, np.uint8))


def filled(values, dtype=np.uint8) -> np.ndarray:
    return np.tile(np.array(values, dtype), (8, 8, 1))


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", filled(RED)),
        ("bgr8", filled(RED[::-1])),
        ("rgba8", filled((*RED, 7))),
        ("bgra8", filled((*RED[::-1], 7))),
        ("8UC3", filled(RED[::-1])),
        ("rgb16", filled(np.array(RED) * 257, np.uint16)),
        ("bgr16", filled(np.array(RED[::-1]) * 257, np.uint16)),
    ],
)
def test_channels_are_in_the_order_of_rgb(encoding, pixels):
    np.testing.assert_allclose(colour_of(raw(pixels, encoding)), filled(RED) / 255, atol=1e-6)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_mosaics(pattern):
    mosaic = np.zeros((8, 8), np.uint8)
    for place, channel in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = RED["rgb".index(channel)]
    decoded = colour_of(raw(mosaic[..., None], f"bayer_{pattern}8"))
    np.testing.assert_allclose(decoded[2:-2, 2:-2], filled(RED)[2:-2, 2:-2] / 255, atol=0.02)


@pytest.mark.parametrize(("encoding", "luma_first"), [("yuv422_yuy2", True), ("uyvy", False)])
def test_yuv(encoding, luma_first):
    y = 150  # of 16 to 235; the chroma 128 is neutral
    pair = np.array([[y, 128, y, 128]] if luma_first else [[128, y, 128, y]], np.uint8)
    decoded = colour_of(raw(np.tile(pair, (8, 4)).reshape(8, 8, 2), encoding))
    assert np.ptp(decoded) < 0.01
    assert decoded.mean() == pytest.approx((y - 16) / 219, abs=0.01)


@pytest.mark.parametrize(
    ("encoding", "dtype", "highest"), [("mono8", np.uint8, 255), ("mono16", np.uint16, 65535)]
)
def test_grey_images_have_three_equal_channels(encoding, dtype, highest):
    decoded = colour_of(raw(filled([highest // 5], dtype), encoding))
    np.testing.assert_allclose(decoded, np.full((8, 8, 3), 0.2), atol=1e-5)


def test_compressed_colour_and_grey():
    data = cv2.imencode(".png", filled(RED[::-1]))[1].tobytes()
    message = compressed(data, "rgb8; png compressed bgr8")
    np.testing.assert_allclose(colour_of(message), filled(RED) / 255, atol=1e-6)
    assert size_of(message) == (8, 8)
    assert not is_grey(message)
    grey = compressed(cv2.imencode(".jpg", filled([51])[..., 0])[1].tobytes(), "jpeg")
    assert is_grey(grey)
    np.testing.assert_allclose(colour_of(grey), np.full((8, 8, 3), 0.2), atol=0.01)


@pytest.mark.parametrize("big_endian", [False, True])
def test_integer_depth_in_both_byte_orders(big_endian):
    pixels = np.full((4, 5, 1), 1234, ">u2" if big_endian else "<u2")
    pixels[0, 0] = 0
    depth_m = depth_m_of(raw(pixels, "16UC1", big_endian), 0.001)
    assert depth_m.shape == (4, 5)
    assert depth_m[0, 0] == 0
    assert depth_m[1, 1] == pytest.approx(1.234)


def test_depth_in_metres_has_no_invalid_values():
    pixels = np.full((4, 4, 1), 1.5, np.float32)
    pixels[0, :3, 0] = np.nan, np.inf, -1.0
    depth_m = depth_m_of(raw(pixels, "32FC1"), 0.001)
    np.testing.assert_array_equal(depth_m[0], [0, 0, 0, 1.5])


def test_compressed_integer_depth():
    png = cv2.imencode(".png", np.full((4, 4), 2500, np.uint16))[1].tobytes()
    header = struct.pack("<iff", 0, 0.0, 0.0)
    message = compressed(header + png, "16UC1; compressedDepth png")
    assert is_depth("/depth/compressedDepth", message)
    np.testing.assert_allclose(depth_m_of(message, 0.001), np.full((4, 4), 2.5), atol=1e-6)


def test_compressed_depth_in_metres_is_quantised_inverse_depth():
    """compressed_depth_image_transport: A = q (q + 1), B = 1 - A / max, value = A / depth + B."""
    depth_m, quantisation, maximum = 2.5, 100.0, 10.0
    scale = quantisation * (quantisation + 1)
    offset = 1.0 - scale / maximum
    value = round(scale / depth_m + offset)
    values = np.full((4, 4), value, np.uint16)
    values[0, 0] = 0
    data = struct.pack("<iff", 0, scale, offset) + cv2.imencode(".png", values)[1].tobytes()
    decoded = depth_m_of(compressed(data, "32FC1; compressedDepth png"), 0.001)
    assert decoded[0, 0] == 0
    assert decoded[1, 1] == pytest.approx(depth_m, rel=1e-3)


@pytest.mark.parametrize(
    ("topic", "encoding", "depth"),
    [
        ("/camera/depth/image", "16UC1", True),
        ("/depth", "32FC1", True),
        ("/device_0/sensor_0/Depth_0/image/data", "mono16", True),
        ("/thermal/image", "mono16", False),
        ("/depth/preview", "rgb8", False),
    ],
)
def test_depth_is_recognised_by_encoding_and_name(topic, encoding, depth):
    assert is_depth(topic, SimpleNamespace(encoding=encoding)) == depth


@pytest.mark.parametrize(
    "broken",
    [
        SimpleNamespace(**vars(raw(filled(RED), "rgb8")) | {"data": np.zeros(5, np.uint8)}),
        raw(filled(RED), "nv12"),
        compressed(b"no image", "jpeg"),
        compressed(b"", "jpeg"),
    ],
)
def test_what_cannot_be_decoded_is_refused_in_one_line(broken):
    with pytest.raises(DatasetError) as refusal:
        colour_of(broken)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("data", [b"short", struct.pack("<iff", 0, 0, 0) + b"RVL data"])
def test_other_compressed_depth_is_refused(data):
    with pytest.raises(DatasetError):
        depth_m_of(compressed(data, "16UC1; compressedDepth rvl"), 0.001)
