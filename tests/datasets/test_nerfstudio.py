"""Recordings described by nerfstudio's transforms.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_formats import check_frames, check_truth

from toolkit.base.errors import DatasetError
from toolkit.datasets.registry import open_dataset
from toolkit.io import images


def changed(folder: Path, frame: int | None = None, **values: Any) -> Path:
    """Change values of the file or of one frame; None removes."""
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    target = content if frame is None else content["frames"][frame]
    target |= values
    for key in [key for key, value in values.items() if value is None]:
        del target[key]
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("enlarged", [1, 2])
def test_frames_camera_and_poses_are_those_written(make_nerfstudio, enlarged):
    """Sorted by number, with pixel centres at integers, and colour resized to depth."""
    dataset = open_dataset("nerfstudio", make_nerfstudio(frames=12, enlarged=enlarged))
    check_frames(dataset, list(range(12)))
    check_truth(dataset, list(range(12)), list(range(12)))
    camera = dataset.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 31.0, 15.5, 11.5)
    assert camera.size == (32, 24)
    assert dataset.recording.flaws == ()


def test_numbers_in_the_names_of_frames_are_sorted_by_value(make_nerfstudio):
    folder = make_nerfstudio(frames=12)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        for key in ("file_path", "depth_file_path"):
            old = Path(frame[key].replace("\\", "/"))
            frame[key] = str(old.with_name(f"r_{old.name}"))
            (folder / old).rename(folder / frame[key])
    (folder / "transforms.json").write_text(json.dumps(content))
    check_frames(open_dataset("nerfstudio", folder), list(range(12)))


def test_a_point_keeps_its_place_in_the_world(make_nerfstudio):
    """A point 2 m in front of the second camera, projected by the conventions of the format."""
    folder = make_nerfstudio()
    dataset = open_dataset("nerfstudio", folder)
    content = json.loads((folder / "transforms.json").read_text())
    frame = next(f for f in content["frames"] if f["file_path"].endswith("/2.png"))
    u, v, z = 20.0, 5.0, 2.0  # of the pixel in column 20 and row 5, whose centre is (20.5, 5.5)
    x_right, y_up = (u + 0.5 - 16.0) / 30.0 * z, -(v + 0.5 - 12.0) / 31.0 * z
    expected = np.array(frame["transform_matrix"]) @ [x_right, y_up, -z, 1.0]
    camera, T = dataset.camera, dataset.ground_truth.T_world_camera[1]
    ours = T @ [(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 1.0]
    np.testing.assert_allclose(ours, expected, atol=1e-9)


def test_frames_without_depth_are_left_out_and_reported(make_nerfstudio):
    folder = changed(make_nerfstudio(), frame=1, depth_file_path=None)  # written in reverse: 3.png
    dataset = open_dataset("nerfstudio", folder)
    check_frames(dataset, [0, 1, 3])
    assert dataset.recording.flaws == ("1 colour image(s) without depth: 3.png",)


def test_small_differences_of_the_focus_are_averaged(make_nerfstudio):
    folder = changed(make_nerfstudio(), frame=0, fl_x=30.3)
    dataset = open_dataset("nerfstudio", folder)
    assert dataset.camera.fx == 30.0
    assert "1.0 %" in dataset.recording.flaws[0]


def test_a_field_of_view_serves_as_focal_length(make_nerfstudio):
    angle = 2 * np.arctan(16.0 / 40.0)
    folder = changed(make_nerfstudio(), fl_x=None, fl_y=None, camera_angle_x=angle)
    camera = open_dataset("nerfstudio", folder).camera
    assert (camera.fx, camera.fy) == pytest.approx((40.0, 40.0))


def test_the_unit_of_depth_can_be_given(make_nerfstudio):
    folder = changed(make_nerfstudio(), depth_unit_scale_factor=0.0005)
    depth_m = open_dataset("nerfstudio", folder)[0].depth_m
    assert depth_m[0, 0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize(
    ("frame", "values", "message"),
    [
        (None, {"frames": []}, "no list of frames"),
        (None, {"fl_x": None}, "lacks the number fl_x"),
        (None, {"fl_x": "wide"}, "no valid number fl_x"),
        (None, {"fl_x": -5.0}, "correct the intrinsics"),
        (None, {"camera_model": "EQUIRECTANGULAR"}, "undistort the images"),
        (0, {"camera_model": "OPENCV_FISHEYE"}, "several camera models"),
        (None, {"k4": 0.1}, "distortion beyond k3"),
        (None, {"depth_unit_scale_factor": 0}, "must be positive"),
        (0, {"fl_x": 33.0}, "record with fixed focus"),
        (0, {"w": 64}, "different sizes"),
        (0, {"transform_matrix": [[1, 0], [0, 1]]}, "not a 4x4 matrix"),
        (0, {"file_path": None}, "must have a file_path"),
    ],
)
def test_bad_files_are_refused_in_one_line(make_nerfstudio, frame, values, message):
    folder = changed(make_nerfstudio(), frame=frame, **values)
    with pytest.raises(DatasetError, match=message) as refusal:
        open_dataset("nerfstudio", folder)
    assert "transforms.json" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_fisheye_images_have_four_coefficients(make_nerfstudio):
    values = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
    folder = changed(make_nerfstudio(), camera_model="OPENCV_FISHEYE", **values)
    recording = open_dataset("nerfstudio", folder).recording
    assert recording.fisheye
    assert recording.distortion == (0.1, 0.2, 0.3, 0.4)


def test_without_depth_colour_keeps_its_size(make_nerfstudio):
    folder = make_nerfstudio(frames=2, enlarged=2)
    dataset = open_dataset("nerfstudio", folder, needs_depth=False)
    assert dataset.camera.size == (64, 48)
    assert (dataset.camera.fx, dataset.camera.cx) == (60.0, 31.5)
    frame = dataset[1]
    assert frame.rgb.shape == (48, 64, 3)
    small = open_dataset("nerfstudio", folder)[1]
    np.testing.assert_array_equal(frame.depth_m[::2, ::2], small.depth_m)


def test_colour_only_needs_the_option_for_missing_depth(make_nerfstudio):
    folder = make_nerfstudio(frames=2)
    for frame in range(2):
        changed(folder, frame=frame, depth_file_path=None)
    with pytest.raises(DatasetError, match="has no depth images"):
        open_dataset("nerfstudio", folder)
    dataset = open_dataset("nerfstudio", folder, needs_depth=False)
    assert len(dataset) == 2
    assert not dataset[1].depth_m.any()
    assert dataset[1].rgb.any()


def test_depth_of_another_aspect_ratio_is_refused(make_nerfstudio):
    folder = make_nerfstudio(frames=1)
    images.write_depth_png(folder / "depths/1.png", np.ones((24, 24)), 1000)
    with pytest.raises(DatasetError, match="same aspect ratio"):
        open_dataset("nerfstudio", folder)


def test_broken_json_names_the_file(make_nerfstudio):
    folder = make_nerfstudio()
    (folder / "transforms.json").write_text("{")
    with pytest.raises(DatasetError, match=r"cannot read .*transforms\.json"):
        open_dataset("nerfstudio", folder)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_blenders_layout_has_no_sizes_and_no_endings(make_nerfstudio, suffix):
    folder = make_nerfstudio()
    content = json.loads((folder / "transforms.json").read_text())
    expected = open_dataset("nerfstudio", folder, needs_depth=False)
    (folder / "transforms.json").unlink()
    frames = []
    for frame in sorted(content["frames"], key=lambda frame: frame["file_path"]):
        name = folder / frame["file_path"]
        images.write_rgb(name.with_name(f"r.{name.stem}{suffix}"), images.read_rgb(name))
        path = f"./images/r.{name.stem}"
        frames.append({"file_path": path, "transform_matrix": frame["transform_matrix"]})
    angle = 2 * np.arctan(0.5 * content["w"] / content["fl_x"])
    written = {"camera_angle_x": angle, "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(written))
    found = open_dataset("nerfstudio", folder, needs_depth=False)
    assert [file.rgb.name for file in found.recording.files] == [
        f"r.{k + 1}{suffix}" for k in range(4)
    ]
    assert found.camera.size == expected.camera.size
    assert found.camera.fx == pytest.approx(expected.camera.fx)
    np.testing.assert_allclose(
        found.ground_truth.T_world_camera, expected.ground_truth.T_world_camera
    )
