"""Films of phones: focal length in the metadata, portrait rotation, variable frame rate."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from film_boxes import box, change, turned_upright

from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.readers.video import FILM_FOCAL_SIGMA, STABILISATION_CROP, TYPICAL_FOCAL
from toolkit.datasets.registry import open_dataset
from toolkit.io.quicktime import EQUIVALENT_FOCAL_MM, read_metadata

WIDTH, HEIGHT, FRAMES = 64, 36, 5


def metadata(value: bytes, kind: int, versioned: bool = False) -> bytes:
    """The box `meta` with the focal length as second key."""
    names = [b"com.apple.quicktime.make", EQUIVALENT_FOCAL_MM.encode()]
    keys = struct.pack(">II", 0, len(names)) + b"".join(box(b"mdta", name) for name in names)
    items = [
        box(struct.pack(">I", number), box(b"data", struct.pack(">II", form, 0) + payload))
        for number, form, payload in ((1, 1, b"Apple"), (2, kind, value))
    ]
    handler = box(b"hdlr", bytes(8) + b"mdta" + bytes(12))
    content = handler + box(b"keys", keys) + box(b"ilst", b"".join(items))
    return box(b"meta", (bytes(4) if versioned else b"") + content)


@pytest.fixture
def film(tmp_path) -> Path:
    """Frames whose first quarter is brighter than the rest, ever more so."""
    path = tmp_path / "film.mov"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (WIDTH, HEIGHT))
    for n in range(FRAMES):
        image = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
        image[: HEIGHT // 2, : WIDTH // 2] = 60 + 40 * n
        writer.write(image)
    writer.release()
    return path


def add_to(kind: bytes, addition: bytes) -> Callable[[bytes, bytes], bytes]:
    return lambda found, content: content + addition if found == kind else content


def opened(path: Path, **options):
    return open_dataset("video", path, needs_depth=False, options=DatasetOptions(**options))


@pytest.mark.parametrize("place", [b"moov", b"trak"])
@pytest.mark.parametrize("versioned", [False, True])
@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (b"26", 1),
        (struct.pack(">f", 26), 23),
        (struct.pack(">d", 26), 24),
        (struct.pack(">b", 26), 21),
        (struct.pack(">i", 26), 67),
        (struct.pack(">H", 26), 76),
    ],
)
def test_the_focal_length_of_a_phone_is_an_initial_value(film, place, versioned, value, kind):
    change(film, add_to(place, metadata(value, kind, versioned)))
    found = read_metadata(film)
    assert found["com.apple.quicktime.make"] == "Apple"
    assert float(found[EQUIVALENT_FOCAL_MM]) == 26
    recording = opened(film).recording
    assert not recording.calibrated
    assert recording.focal_sigma == FILM_FOCAL_SIGMA
    # The diagonal of 4:3 is 5/4 of its width.
    expected = STABILISATION_CROP * 26 / np.hypot(36, 24) * 1.25 * WIDTH
    assert recording.camera.fx == pytest.approx(expected)
    assert "in the metadata of the film" in recording.notes[0]


@pytest.mark.parametrize("value", [b"wide", b"0", b"-13", b"1e9", b"nan", b""])
def test_a_senseless_focal_length_is_ignored(film, value):
    change(film, add_to(b"moov", metadata(value, 1)))
    recording = opened(film).recording
    assert recording.camera.fx == pytest.approx(TYPICAL_FOCAL * WIDTH)
    assert recording.focal_sigma is None


def test_damaged_metadata_is_ignored(film, tmp_path):
    assert read_metadata(film) == {}
    assert read_metadata(tmp_path / "none.mov") == {}
    whole = metadata(b"26", 1)
    for length in range(0, len(whole), 3):
        path = tmp_path / "cut.mov"
        path.write_bytes(box(b"moov", whole[:length]))
        read_metadata(path)
    path.write_bytes(box(b"free", b"") + struct.pack(">I4s", 4, b"moov"))
    assert read_metadata(path) == {}


def test_a_portrait_film_is_shown_upright_with_intrinsics_for_it(film):
    change(film, turned_upright(HEIGHT))
    dataset = opened(film)
    assert dataset.camera.size == (HEIGHT, WIDTH)
    assert dataset[0].rgb.shape == (WIDTH, HEIGHT, 3)
    # The upper left quarter is now the upper right one.
    quarter = dataset[4].rgb[: WIDTH // 2, HEIGHT // 2 :]
    assert quarter.mean() == pytest.approx(220 / 255, abs=0.03)
    assert dataset[4].rgb[: WIDTH // 2, : HEIGHT // 2].mean() < 0.2
    film.with_suffix(".yaml").write_text(
        f"fx: 50\nfy: 51\ncx: 17\ncy: 31\nwidth: {HEIGHT}\nheight: {WIDTH}\n"
        "distortion: [0.2, 0, 0.05, 0, 0]\n"
    )
    calibrated = opened(film)
    assert (calibrated.camera.cx, calibrated.camera.cy) == (17, 31)
    expected = cv2.undistort(
        dataset[4].rgb, calibrated.camera.matrix, np.array([0.2, 0, 0.05, 0, 0])
    )
    middle = np.s_[16:48, 9:27]
    np.testing.assert_allclose(calibrated[4].rgb[middle], expected[middle], atol=0.02)


def test_variable_frame_rates_and_dropped_frames_keep_their_times(film):
    def vary(kind: bytes, content: bytes) -> bytes:
        if kind == b"edts":  # limits the film to its former duration
            return box(b"free", b"")
        if kind != b"stts":
            return content
        _, entries, count, ticks = struct.unpack(">IIII", content)
        assert (entries, count) == (1, FRAMES)
        # Two frames at the normal rate, then three frames after a gap of two dropped ones.
        return struct.pack(">IIIIIIII", 0, 3, 1, ticks, 1, 3 * ticks, FRAMES - 2, ticks)

    change(film, vary)
    dataset = opened(film)
    np.testing.assert_allclose(25 * dataset.timestamps_s, [0, 1, 4, 5, 6], atol=1e-3)
    for n in (3, 0, 4):
        quarter = dataset[n].rgb[: HEIGHT // 2, : WIDTH // 2]
        assert quarter.mean() == pytest.approx((60 + 40 * n) / 255, abs=0.03)
