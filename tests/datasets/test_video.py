"""Films, with and without intrinsics."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.base.errors import DatasetError
from toolkit.datasets.checks import check_recording
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.readers.video import TYPICAL_FOCAL
from toolkit.datasets.registry import describe, open_dataset

WIDTH, HEIGHT, FRAMES, FPS = 64, 48, 5, 25.0
INTRINSICS = "fx: 50\nfy: 51\ncx: 31.5\ncy: 23.5\nwidth: 64\nheight: 48\n"


@pytest.fixture
def film(tmp_path) -> Path:
    path = tmp_path / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), FPS, (WIDTH, HEIGHT))
    for n in range(FRAMES):
        writer.write(np.full((HEIGHT, WIDTH, 3), 40 * (n + 1), np.uint8))
    writer.release()
    return path


def opened(path: Path, image_size: tuple[int, int] | None = None, **values):
    options = DatasetOptions(**values)
    return open_dataset("video", path, image_size, needs_depth=False, options=options)


def test_every_frame_has_its_time_and_no_depth(film):
    dataset = opened(film)
    assert dataset.name == "film"
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(FRAMES) / FPS, atol=1e-6)
    for n, frame in enumerate(dataset):
        assert frame.rgb.mean() == pytest.approx(40 * (n + 1) / 255, abs=0.02)
        assert not frame.depth_m.any()


def test_without_intrinsics_the_focal_length_is_typical_and_not_calibrated(film):
    dataset = opened(film)
    assert not dataset.recording.calibrated
    assert dataset.camera.fx == pytest.approx(TYPICAL_FOCAL * WIDTH)
    assert (dataset.camera.cx, dataset.camera.cy) == (31.5, 23.5)


def test_a_file_beside_the_film_has_the_intrinsics(film):
    film.with_suffix(".yaml").write_text(INTRINSICS + "distortion: [0.1, 0, 0, 0, 0]\n")
    recording = opened(film).recording
    assert recording.calibrated
    assert (recording.camera.fx, recording.camera.fy) == (50.0, 51.0)
    assert recording.distortion == (0.1, 0.0, 0.0, 0.0, 0.0)


def test_a_field_of_view_gives_the_focal_length(film):
    dataset = opened(film, fov_deg=90.0)
    assert dataset.recording.calibrated
    assert dataset.camera.fx == pytest.approx(WIDTH / 2)


def test_intrinsics_and_field_of_view_contradict(film):
    film.with_suffix(".yaml").write_text(INTRINSICS)
    with pytest.raises(DatasetError, match="remove the field of view"):
        opened(film, fov_deg=90.0)


def test_intrinsics_of_another_size_are_rejected(film):
    film.with_suffix(".yaml").write_text(INTRINSICS.replace("width: 64", "width: 640"))
    with pytest.raises(
        DatasetError, match=r"is for 640x48 pixels but film\.mp4 is shown with 64x48"
    ):
        opened(film)


def test_large_films_are_reduced(tmp_path):
    path = tmp_path / "large.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), FPS, (1080, 1920))
    writer.write(np.full((1920, 1080, 3), 90, np.uint8))
    writer.release()
    dataset = opened(path)
    assert dataset.camera.size == (360, 640)
    assert dataset[0].rgb.shape == (640, 360, 3)
    assert dataset.camera.fx == pytest.approx(TYPICAL_FOCAL * 640)
    assert opened(path, image_size=(1080, 1920)).camera.size == (1080, 1920)


def test_a_film_needs_the_option_for_missing_depth(film):
    with pytest.raises(DatasetError, match=r"film.mp4 has no depth images; .* --depth none"):
        open_dataset("video", film)


def test_a_folder_is_not_a_film(tmp_path):
    with pytest.raises(DatasetError, match="specify the film"):
        opened(tmp_path)


def test_a_damaged_film_is_named(tmp_path):
    path = tmp_path / "film.mp4"
    path.write_bytes(b"no film")
    with pytest.raises(DatasetError, match="not a video"):
        opened(path)


def test_checks_state_that_there_is_no_depth(film):
    report = check_recording(describe("video", film))
    assert "depth: none; run with --depth none" in report.summary
    assert not any("depth" in fault for fault in report.faults)
