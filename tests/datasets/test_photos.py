"""Folders and lists of photos: order, orientation and focal length."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.orientation import oriented, oriented_camera, oriented_distortion
from toolkit.datasets.readers.video import TYPICAL_FOCAL
from toolkit.datasets.registry import open_dataset
from toolkit.io.exif import FILM_DIAGONAL_MM, read_photo_info

WIDTH, HEIGHT = 40, 30
INTRINSICS = "fx: 50\nfy: 51\ncx: 18\ncy: 12\nwidth: 40\nheight: 30\nfps: 10\n"
ORIENTATION, EXIF_IFD = 0x0112, 0x8769
FOCAL_MM, EQUIVALENT_MM, STORED_WIDTH, RESOLUTION, UNIT = 0x920A, 0xA405, 0xA002, 0xA20E, 0xA210


def grey(index: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 40 * index + 10, np.uint8)


def write_photo(
    path: Path, pixels: np.ndarray, orientation: int | None = None, **tags: float
) -> Path:
    """Write with EXIF's orientation and tags of `named`."""
    named = {
        "focal_mm": FOCAL_MM,
        "equivalent_mm": EQUIVALENT_MM,
        "stored_width": STORED_WIDTH,
        "resolution": RESOLUTION,
        "unit": UNIT,
    }
    exif = Image.Exif()
    if orientation is not None:
        exif[ORIENTATION] = orientation
    exif.get_ifd(EXIF_IFD).update({named[name]: value for name, value in tags.items()})
    Image.fromarray(pixels).save(path, exif=exif)
    return path


@pytest.fixture
def photos(tmp_path) -> Path:
    folder = tmp_path / "walk"
    folder.mkdir()
    for index, name in enumerate(("IMG_2.png", "IMG_10.png", "IMG_11.PNG")):
        write_photo(folder / "x.png", grey(index)).rename(folder / name)
    (folder / "._IMG_2.png").write_bytes(b"of macOS")
    return folder


def opened(path: Path, **options):
    return open_dataset("images", path, needs_depth=False, options=DatasetOptions(**options))


def test_images_are_in_natural_order_without_intrinsics(photos):
    dataset = opened(photos)
    assert dataset.stems == ["IMG_2", "IMG_10", "IMG_11"]
    assert [round(255 * frame.rgb[0, 0, 0]) for frame in dataset] == [10, 50, 90]
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(3) / 30)
    assert not dataset.recording.calibrated
    assert dataset.recording.focal_sigma is None
    assert dataset.camera.fx == pytest.approx(TYPICAL_FOCAL * WIDTH)


def test_a_list_gives_the_order(photos, tmp_path):
    (tmp_path / "list.txt").write_text("# mine\nwalk/IMG_11.PNG\nwalk\\IMG_2.png\n")
    dataset = opened(tmp_path / "list.txt")
    assert dataset.stems == ["IMG_11", "IMG_2"]
    (tmp_path / "list.txt").write_text("walk/IMG_11.PNG\nwalk/IMG_3.png\n")
    with pytest.raises(DatasetError, match=r"list\.txt, line 2: there is no file"):
        opened(tmp_path / "list.txt")


def test_the_folder_above_is_accepted(photos):
    assert len(opened(photos.parent)) == 3
    (photos.parent / "other").mkdir()
    write_photo(photos.parent / "other/1.png", grey(0))
    with pytest.raises(DatasetError, match=r"contains 2 folders with images \(other, walk\)"):
        opened(photos.parent)


def test_intrinsics_beside_the_images(photos):
    (photos / "intrinsics.yaml").write_text(INTRINSICS + "distortion: [0.1, 0, 0, 0, 0]\n")
    recording = opened(photos).recording
    assert recording.calibrated
    assert recording.camera == Camera(50, 51, 18, 12, WIDTH, HEIGHT)
    assert recording.distortion == (0.1, 0, 0, 0, 0)
    assert recording.files[1].timestamp_s == pytest.approx(0.1)
    with pytest.raises(DatasetError, match="remove the field of view"):
        opened(photos, fov_deg=60.0)


def test_a_field_of_view_replaces_the_estimate(photos):
    dataset = opened(photos, fov_deg=90.0)
    assert dataset.recording.calibrated
    assert dataset.camera.fx == pytest.approx(WIDTH / 2)


@pytest.mark.parametrize(
    ("tags", "focal_px"),
    [
        ({"equivalent_mm": 26}, 26 / FILM_DIAGONAL_MM * 50),
        # 100 pixels per millimetre of an original that was twice as wide.
        ({"focal_mm": 4.0, "resolution": 2540.0, "unit": 2, "stored_width": 80}, 200.0),
        ({"focal_mm": 4.0, "resolution": 1000.0, "unit": 3}, 400.0),
        ({"focal_mm": 4.0, "equivalent_mm": 26}, 26 / FILM_DIAGONAL_MM * 50),
        ({"focal_mm": 0.0, "resolution": 2540.0, "equivalent_mm": 0}, None),
        ({}, None),
    ],
)
def test_the_focal_length_of_exif_is_an_initial_value(tmp_path, tags, focal_px):
    path = write_photo(tmp_path / "1.jpg", grey(0), **tags)
    assert read_photo_info(path).focal_px == pytest.approx(focal_px)
    recording = opened(tmp_path).recording
    assert not recording.calibrated
    assert recording.camera.fx == pytest.approx(focal_px or TYPICAL_FOCAL * WIDTH)
    assert (recording.focal_sigma is None) == (focal_px is None)


def test_zoom_is_refused(tmp_path):
    for index, focal in enumerate((26, 26, 52)):
        write_photo(tmp_path / f"{index}.jpg", grey(index), equivalent_mm=focal)
    with pytest.raises(DatasetError, match=r"differ by 100 % .* one camera and zoom"):
        opened(tmp_path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_shown_as_pillow_and_opencv_show_them(tmp_path, orientation):
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:4, :9] = 255
    path = write_photo(tmp_path / "1.png", pixels, orientation)
    shown = opened(tmp_path)[0].rgb
    np.testing.assert_array_equal(np.round(255 * shown), cv2.imread(str(path)))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_intrinsics_turn_with_the_image(orientation):
    """A distorted pixel keeps its place in the picture, whatever the orientation."""
    camera = Camera(50.0, 52.0, 18.0, 12.0, WIDTH, HEIGHT)
    distortion = (0.1, 0.02, 0.03, -0.04, 0.01)
    point = np.array([0.2, -0.1, 1.0])
    place = cv2.projectPoints(
        point[None], np.zeros(3), np.zeros(3), camera.matrix, np.array(distortion)
    )[0].ravel()
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    # The same transformation on the coordinates of the pixels and on the direction of the point.
    shown_camera = oriented_camera(camera, orientation)
    directions = np.stack([columns, rows], axis=-1).astype(float)
    shown = oriented(directions, orientation)
    assert shown.shape[:2] == (shown_camera.height, shown_camera.width)
    origin, right, down = shown[0, 0], shown[0, 1] - shown[0, 0], shown[1, 0] - shown[0, 0]
    axes = np.array([right, down])
    turned = np.append(axes @ point[:2], 1.0)
    moved = cv2.projectPoints(
        turned[None],
        np.zeros(3),
        np.zeros(3),
        shown_camera.matrix,
        np.array(oriented_distortion(distortion, orientation)),
    )[0].ravel()
    np.testing.assert_allclose(origin + moved @ axes, place, atol=1e-9)


def test_intrinsics_of_the_stored_pixels_are_turned(tmp_path):
    write_photo(tmp_path / "1.jpg", grey(0), orientation=6)
    (tmp_path / "intrinsics.yaml").write_text(INTRINSICS)
    camera = opened(tmp_path).camera
    assert camera == Camera(51, 50, HEIGHT - 1 - 12, 18, HEIGHT, WIDTH)
    (tmp_path / "intrinsics.yaml").write_text(INTRINSICS.replace("width: 40", "width: 50"))
    with pytest.raises(DatasetError, match="is for 50x30 pixels but the images have 30x40"):
        opened(tmp_path)


def test_portrait_and_landscape_do_not_mix(tmp_path):
    for index in range(3):
        write_photo(tmp_path / f"{index}.jpg", grey(index), 6 if index == 1 else 1)
    with pytest.raises(DatasetError, match=r"1 are not 40x30 \(1\.jpg\)"):
        opened(tmp_path)


def test_other_content_is_refused_in_one_line(tmp_path):
    with pytest.raises(DatasetError, match="does not exist"):
        opened(tmp_path / "none")
    with pytest.raises(DatasetError, match="contains no JPEG or PNG images; check the path"):
        opened(tmp_path)
    (tmp_path / "1.HEIC").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"convert its \.HEIC files to JPEG"):
        opened(tmp_path)
    (tmp_path / "1.jpg").write_bytes(b"no image")
    with pytest.raises(DatasetError, match=r"cannot read image .*1\.jpg"):
        opened(tmp_path)
    with pytest.raises(DatasetError, match="is one image"):
        opened(tmp_path / "1.jpg")
