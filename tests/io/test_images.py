"""Image round trips and errors for damaged files."""

import os
import sys

import cv2
import numpy as np
import pytest
from PIL import Image

from toolkit.base.errors import DatasetError, DependencyError, RunFolderError
from toolkit.io import images


@pytest.fixture
def rgb() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (24, 32, 3)).astype(np.float32) / 255


@pytest.fixture(params=["open3d", "opencv"])
def decoder(request, monkeypatch):
    """Both decoders: Open3D, and OpenCV where Open3D cannot be loaded."""
    if request.param == "opencv":

        def no_open3d():
            raise DependencyError("no Open3D here")

        monkeypatch.setattr(images, "open3d", no_open3d)
    images._decoder.cache_clear()
    yield request.param
    images._decoder.cache_clear()


def test_png_colour_round_trip_in_rgb_order(tmp_path, rgb, decoder):
    images.write_rgb(tmp_path / "c.png", rgb)
    np.testing.assert_allclose(images.read_rgb(tmp_path / "c.png"), rgb, atol=1e-6)
    assert images.read_rgb(tmp_path / "c.png").dtype == np.float32


def test_colour_out_of_range_is_clamped(tmp_path):
    images.write_rgb(tmp_path / "c.png", np.full((2, 2, 3), [-1.0, 0.5, 7.0]))
    np.testing.assert_allclose(
        images.read_rgb(tmp_path / "c.png")[0, 0], [0.0, 0.5, 1.0], atol=0.003
    )


def test_greyscale_and_alpha_are_converted_to_rgb(tmp_path, decoder):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 4), 51, np.uint8))
    cv2.imwrite(str(tmp_path / "alpha.png"), np.full((4, 4, 4), [255, 0, 51, 9], np.uint8))
    np.testing.assert_allclose(images.read_rgb(tmp_path / "grey.png"), 0.2, atol=1e-6)
    np.testing.assert_allclose(
        images.read_rgb(tmp_path / "alpha.png")[0, 0], [0.2, 0.0, 1.0], atol=1e-6
    )


def test_depth_is_value_divided_by_scale_and_0_and_65535_are_missing(tmp_path, decoder):
    raw = np.array([[0, 5000], [65535, 2500]], np.uint16)
    images.write_png(tmp_path / "d.png", raw)
    depth_m = images.read_depth_m(tmp_path / "d.png", 5000)
    np.testing.assert_allclose(depth_m, [[0, 1], [0, 0.5]])


def test_depth_out_of_range_is_written_as_missing(tmp_path):
    images.write_depth_png(
        tmp_path / "d.png", np.array([[1.0, 70.0, np.nan, -1.0, np.inf, 0.0]]), 1000
    )
    np.testing.assert_array_equal(
        images.read_depth_m(tmp_path / "d.png", 1000), np.float32([[1, 0, 0, 0, 0, 0]])
    )


def test_eight_bit_depth_raises(tmp_path):
    images.write_png(tmp_path / "d.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(DatasetError, match=r"d\.png.*16-bit"):
        images.read_depth_m(tmp_path / "d.png", 1000)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_label_round_trip(tmp_path, dtype, decoder):
    ids = np.arange(12).reshape(3, 4).astype(dtype) * 20
    images.write_png(tmp_path / "l.png", ids)
    labels = images.read_labels(tmp_path / "l.png")
    assert labels.dtype == np.int32
    np.testing.assert_array_equal(labels, ids)


@pytest.mark.parametrize("colours", [2, 16, 250])
def test_labels_of_a_palette_are_its_indices(tmp_path, colours, decoder):
    ids = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20 % colours
    image = Image.fromarray(ids, mode="P")
    image.putpalette(np.random.default_rng(0).integers(0, 256, 3 * colours).tolist())
    image.save(tmp_path / "l.png", bits=(colours - 1).bit_length())
    np.testing.assert_array_equal(images.read_labels(tmp_path / "l.png"), ids)
    content = (tmp_path / "l.png").read_bytes()
    (tmp_path / "l.png").write_bytes(content[:-20])
    with pytest.raises(DatasetError, match="truncated"):
        images.read_labels(tmp_path / "l.png")


def test_labels_with_three_channels_raise(tmp_path, rgb):
    images.write_rgb(tmp_path / "l.png", rgb)
    with pytest.raises(DatasetError, match="one channel"):
        images.read_labels(tmp_path / "l.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("lost", ["half", "few bytes"])
def test_truncated_images_raise(tmp_path, rgb, suffix, lost, decoder):
    whole = tmp_path / f"c{suffix}"
    images.write_rgb(whole, rgb)
    content = whole.read_bytes()
    images.read_rgb(whole)
    whole.write_bytes(content[: len(content) // 2] if lost == "half" else content[:-3])
    with pytest.raises(DatasetError, match=rf"c\{suffix} is truncated; copy"):
        images.read_rgb(whole)


def test_png_with_a_flipped_bit_raises(tmp_path, rgb):
    images.write_rgb(tmp_path / "c.png", rgb)
    content = bytearray((tmp_path / "c.png").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "c.png").write_bytes(content)
    with pytest.raises(DatasetError, match="corrupt"):
        images.read_rgb(tmp_path / "c.png")


def test_jpeg_with_trailing_padding_is_accepted(tmp_path, rgb):
    images.write_rgb(tmp_path / "c.jpg", rgb)
    with (tmp_path / "c.jpg").open("ab") as file:
        file.write(bytes(64))
    assert images.read_rgb(tmp_path / "c.jpg").shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("content", "message"), [(b"", "is empty"), (b"GIF89a....", "neither PNG nor JPEG")]
)
def test_files_that_are_not_images_raise(tmp_path, content, message):
    (tmp_path / "c.png").write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        images.read_rgb(tmp_path / "c.png")


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS accepts names in UTF-8 only")
def test_names_that_are_not_utf8(tmp_path, rgb, decoder):
    path = tmp_path / os.fsdecode(b"gr\xf6\xdfe.png")
    images.write_rgb(path, rgb)
    assert images.read_rgb(path).shape == rgb.shape


def test_error_names_the_missing_image(tmp_path):
    with pytest.raises(DatasetError, match=r"nowhere\.png.*No such file"):
        images.read_rgb(tmp_path / "nowhere.png")


def test_error_of_writing_into_a_missing_folder_is_one_line(tmp_path, rgb):
    with pytest.raises(RunFolderError, match=r"cannot write .*c\.png") as caught:
        images.write_rgb(tmp_path / "nowhere" / "c.png", rgb)
    assert "\n" not in str(caught.value)
