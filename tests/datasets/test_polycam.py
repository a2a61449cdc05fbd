"""Raw data of Polycam: images, depth and cameras in ARKit's axes."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_frames import camera_file, frame_depth_m, frame_rgb, pose

from toolkit.base.errors import DatasetError
from toolkit.datasets.registry import open_dataset

FRAMES = 3


@pytest.mark.parametrize("corrected", [True, False])
def test_frames_camera_and_poses_are_those_written(make_polycam, corrected):
    dataset = open_dataset("polycam", make_polycam(corrected))
    assert (dataset.camera.fx, dataset.camera.fy) == (30.0, 31.0)
    assert (dataset.camera.cx, dataset.camera.cy) == (15.5, 11.5)
    np.testing.assert_allclose(dataset.timestamps_s, [9.9, 10.0, 10.1])
    for i in range(FRAMES):
        frame = dataset[i]
        np.testing.assert_allclose(frame.rgb, frame_rgb(i), atol=0.01)
        expected = frame_depth_m(i)
        expected[3, 5] = 0.0
        np.testing.assert_allclose(frame.depth_m, expected, atol=1e-3)
        np.testing.assert_allclose(dataset.ground_truth.T_world_camera[i], pose(i), atol=1e-9)
    assert bool(dataset.recording.notes) != corrected
    assert dataset.recording.flaws == ()
    assert dataset.recording.up_world == (0.0, 1.0, 0.0)


def test_the_folder_of_keyframes_is_accepted(make_polycam):
    assert len(open_dataset("polycam", make_polycam() / "keyframes")) == FRAMES


def test_without_depth_colour_keeps_its_size(make_polycam):
    dataset = open_dataset("polycam", make_polycam(), needs_depth=False)
    assert dataset.camera.size == (64, 48)
    assert (dataset.camera.fx, dataset.camera.cx) == (60.0, 31.5)


def test_incomplete_frames_are_left_out_and_reported(make_polycam):
    folder = make_polycam()
    (folder / "keyframes/depth/9900000.png").unlink()
    (folder / "keyframes/corrected_cameras/10000000.json").unlink()
    recording = open_dataset("polycam", folder).recording
    assert [file.stem for file in recording.files] == ["10100000"]
    assert recording.flaws == (
        "1 image(s) without a camera: 10000000.png",
        "1 image(s) without depth: 9900000.png",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "must be JSON"),
        ("[]", "lacks the number fx"),
        (camera_file(0, t_12=None), "lacks the number t_12"),
        (camera_file(0, fx=0.0), "fx, fy > 0"),
        (camera_file(0, fx=70.0), "record with fixed focus and zoom"),
    ],
)
def test_malformed_cameras_are_refused(make_polycam, text, message):
    folder = make_polycam()
    (folder / "keyframes/corrected_cameras/9900000.json").write_text(text)
    with pytest.raises(DatasetError, match=message):
        open_dataset("polycam", folder)


def test_other_paths_are_refused(tmp_path):
    (tmp_path / "poly.zip").write_bytes(b"")
    with pytest.raises(DatasetError, match="unpack the raw data"):
        open_dataset("polycam", tmp_path / "poly.zip")
    with pytest.raises(DatasetError, match="has no keyframes, which a Polycam dataset needs"):
        open_dataset("polycam", tmp_path)
    (tmp_path / "keyframes").mkdir()
    with pytest.raises(DatasetError, match="no image with a camera of the same name"):
        open_dataset("polycam", tmp_path)
