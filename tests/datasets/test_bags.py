"""Bags: colour, depth and camera info chosen and paired from ROS 1, ROS 2 and RealSense."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_writing import STORAGES, BagContent

from toolkit.base.errors import DatasetError, DependencyError
from toolkit.datasets.checks import check_recording
from toolkit.datasets.options import BagTopics, DatasetOptions
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io import images

SIZE = WIDTH, HEIGHT = 32, 24
K = (30.0, 31.0, 15.5, 11.5)
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
START_S, PERIOD_S = 100.0, 0.1


def grey(index: int) -> int:
    return 30 * (index + 1)


def rgb(index: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), (grey(index), 10, 20), np.uint8)


def depth_mm(index: int) -> np.ndarray:
    values = np.full((HEIGHT, WIDTH), 1000 + 100 * index, np.uint16)
    values[2, 3] = 0
    return values


def write_rgbd(
    folder: Path, storage: str = "sqlite3", frames: int = 4, late_s: float = 0.0, **depth_info
) -> Path:
    """Colour and depth; depth is `late_s` late, and its camera info may differ."""
    content = BagContent(storage)
    content.info("/camera/color/camera_info", K, SIZE)
    content.info(
        "/camera/aligned_depth_to_color/camera_info", **{"K": K, "size": SIZE} | depth_info
    )
    for i in range(frames):
        time_s = START_S + i * PERIOD_S
        content.image(COLOUR, time_s + 0.03, rgb(i), "rgb8", stamp_s=time_s, padding=5)
        content.image(DEPTH, time_s + 0.04, depth_mm(i), "16UC1", stamp_s=time_s + late_s)
    return content.write(folder)


def colour_only(folder: Path, topics: dict[str, str], **info) -> Path:
    """Two frames of each topic (name: encoding), with a camera info if one is described."""
    content = BagContent()
    if info:
        content.info("/camera/camera_info", **info)
    for topic, encoding in topics.items():
        for i in range(2):
            pixels = rgb(i) if encoding == "rgb8" else rgb(i)[..., 0]
            content.image(topic, START_S + i, pixels, encoding)
    return content.write(folder)


def opened(path: Path, **options):
    return open_dataset("bag", path, needs_depth=False, options=DatasetOptions(**options))


@pytest.mark.parametrize("storage", STORAGES)
def test_frames_of_every_storage_are_those_written_in_any_order(tmp_path, storage):
    dataset = open_dataset("bag", write_rgbd(tmp_path, storage))
    assert (dataset.camera.fx, dataset.camera.fy) == K[:2]
    assert (dataset.camera.cx, dataset.camera.cy) == K[2:]
    np.testing.assert_allclose(dataset.timestamps_s, START_S + PERIOD_S * np.arange(4), atol=1e-6)
    for i in (3, 0, 2, 1, 1):
        frame = dataset[i]
        np.testing.assert_array_equal(np.round(255 * frame.rgb), rgb(i))
        np.testing.assert_allclose(frame.depth_m, depth_mm(i) / 1000, atol=1e-6)
    assert dataset.stems == ["000000", "000001", "000002", "000003"]


@pytest.mark.parametrize("storage", STORAGES)
def test_frames_are_read_by_another_thread(tmp_path, storage):
    """SQLite refuses connections of other threads."""
    assert [round(255 * f.rgb[0, 0, 0]) for f in opened(write_rgbd(tmp_path, storage))] == [
        grey(i) for i in range(4)
    ]
    assert threading.active_count() < 50


def test_a_folder_with_only_a_bag_and_the_bare_files_are_read(tmp_path):
    write_rgbd(tmp_path, "sqlite3")
    assert len(opened(tmp_path)) == 4
    assert len(opened(next((tmp_path / "recording").glob("*.db3")))) == 4


def test_compressed_depth_of_a_topic_is_read(tmp_path):
    """Its images start with a header of the plugin, which is no part of the PNG."""
    content = BagContent()
    content.info("/camera/color/camera_info", K, SIZE)
    for i in range(2):
        content.image(COLOUR, START_S + i, rgb(i), "rgb8")
        png = bytes(12) + images.encode_png(depth_mm(i))
        content.compressed(f"{DEPTH}/compressedDepth", START_S + i, png, "16UC1; compressedDepth")
    dataset = open_dataset("bag", content.write(tmp_path))
    np.testing.assert_allclose(dataset[1].depth_m, depth_mm(1) / 1000, atol=1e-6)


def test_a_pipe_instead_of_a_bag_is_not_waited_for(tmp_path):
    file = next(write_rgbd(tmp_path, "mcap").glob("*.mcap"))
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(DatasetError, match="a pipe"):
        opened(tmp_path)


def test_colour_without_depth_in_time_is_left_out(tmp_path):
    content = BagContent()
    content.info("/camera/color/camera_info", K, SIZE)
    for i in range(3):
        content.image(COLOUR, START_S + i, rgb(i), "rgb8")
        if i != 1:
            content.image(DEPTH, START_S + i + 0.015, depth_mm(i), "16UC1")
    dataset = open_dataset("bag", content.write(tmp_path))
    assert [round(255 * dataset[i].rgb[0, 0, 0]) for i in range(2)] == [grey(0), grey(2)]
    assert dataset[1].depth_m.max() == pytest.approx(1.2)
    assert dataset.recording.notes == ("1 colour image(s) without depth within 20 ms",)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"K": (60.0, 60.0, 15.5, 11.5)}, r"f 60\.0\) is not registered to colour"),
        ({"size": (64, 48)}, "camera info is for 64x48"),
    ],
)
def test_depth_of_another_camera_is_refused_with_the_remedy(tmp_path, other, message):
    path = write_rgbd(tmp_path, **other)
    with pytest.raises(DatasetError, match=message) as refusal:
        open_dataset("bag", path)
    if "K" in other:
        assert "aligned_depth_to_color" in str(refusal.value)
        assert len(opened(path)) == 4  # colour alone
        assert any(
            "not registered" in fault for fault in check_recording(describe("bag", path)).faults
        )


def test_depth_of_another_size_is_refused_with_the_remedy(tmp_path):
    content = BagContent()
    content.info("/camera/color/camera_info", K, SIZE)
    content.image(COLOUR, START_S, rgb(0), "rgb8")
    small = np.ones((12, 16), np.uint16)
    content.image("/camera/depth/image_rect_raw", START_S, small, "16UC1", frame_id="depth")
    path = content.write(tmp_path)
    with pytest.raises(DatasetError, match=r"16x12\) is not registered to colour .*--depth none"):
        open_dataset("bag", path)
    assert not opened(path)[0].depth_m.any()


def test_clocks_that_differ_are_reported(tmp_path):
    path = write_rgbd(tmp_path, late_s=5.0)
    with pytest.raises(DatasetError, match="synchronised clocks"):
        open_dataset("bag", path)


def test_a_realsense_recording_has_its_own_names_and_depth_unit(tmp_path):
    content = BagContent("ros1")
    device = "/device_0/sensor_"
    content.info(f"{device}1/Color_0/info/camera_info", K, SIZE, [0] * 5, "Inverse Brown Conrady")
    content.info(f"{device}0/Depth_0/info/camera_info", K, SIZE, [0] * 5, "Brown Conrady")
    content.number(f"{device}0/option/Depth Units/value", 0.0001)
    for i in range(2):
        content.image(f"{device}1/Color_0/image/data", START_S + i, rgb(i), "rgb8", "0")
        content.image(f"{device}0/Depth_0/image/data", START_S + i, depth_mm(i), "mono16", "0")
        infrared = rgb(i)[..., 0]
        content.image(f"{device}0/Infrared_1/image/data", START_S + i, infrared, "mono8", "0")
    dataset = open_dataset("bag", content.write(tmp_path))
    assert dataset.camera.fx == K[0]
    np.testing.assert_allclose(dataset[1].depth_m, depth_mm(1) / 10000, atol=1e-6)
    assert round(255 * dataset[1].rgb[0, 0, 0]) == grey(1)
    assert dataset.recording.depth_scale == pytest.approx(10000)


def test_colour_is_preferred_to_grey_and_raw_to_compressed(tmp_path):
    content = BagContent()
    jpeg = cv2.imencode(".jpg", rgb(5))[1].tobytes()
    content.compressed("/camera/color/image_raw/compressed", START_S, jpeg, "rgb8; jpeg compressed")
    content.image("/camera/infra1/image_rect_raw", START_S, rgb(1)[..., 0], "mono8")
    content.image("/camera/color/image_raw", START_S, rgb(2), "rgb8")
    dataset = opened(content.write(tmp_path))
    assert round(255 * dataset[0].rgb[0, 0, 0]) == grey(2)


def test_rectified_images_have_the_projection_and_no_distortion(tmp_path):
    topics = {"/camera/image_raw": "rgb8", "/camera/image_rect_color": "rgb8"}
    path = colour_only(tmp_path, topics, K=K, size=SIZE, distortion=[0.1, 0, 0, 0, 0])
    recording = opened(path).recording
    assert recording.camera.fx == K[0] + 1
    assert recording.distortion is None


def test_of_a_stereo_pair_the_first_camera_is_used(tmp_path):
    path = colour_only(tmp_path, {"/cam1/image_raw": "mono8", "/cam0/image_raw": "mono8"})
    assert "/cam0/image_raw is used" in opened(path).recording.notes[0]


def test_ambiguous_topics_are_listed_with_the_option_that_selects(tmp_path):
    path = colour_only(tmp_path, {"/front/image": "rgb8", "/rear/image": "rgb8"})
    with pytest.raises(DatasetError, match=r"/front/image, /rear/image.*--dataset.topics.colour"):
        opened(path)
    assert len(opened(path, topics=BagTopics(colour="/rear/image"))) == 2
    with pytest.raises(DatasetError, match="no topic /side/image with colour images; there are"):
        opened(path, topics=BagTopics(colour="/side/image"))


def test_topics_are_for_bags(make_folder):
    options = DatasetOptions(topics=BagTopics(colour="/rgb"))
    with pytest.raises(DatasetError, match="remove it for folder"):
        open_dataset("folder", make_folder(), options=options)


@pytest.mark.parametrize(
    ("model", "values", "expected", "fisheye"),
    [
        ("plumb_bob", [0.1, 0.2, 0.01, 0.02, 0.3], (0.1, 0.2, 0.01, 0.02, 0.3), False),
        ("plumb_bob", [0.1, 0.2, 0.01, 0.02], (0.1, 0.2, 0.01, 0.02, 0.0), False),
        ("plumb_bob", [0.0] * 5, None, False),
        ("rational_polynomial", [0.1] * 5 + [0.0] * 3, (0.1,) * 5, False),
        ("rational_polynomial", [0.1] * 8, (0.1,) * 8, False),
        ("equidistant", [0.1, 0.2, 0.3, 0.4], (0.1, 0.2, 0.3, 0.4), True),
        ("equidistant", [0.0] * 4, (0.0,) * 4, True),
    ],
)
def test_distortion_models(tmp_path, model, values, expected, fisheye):
    topics = {"/camera/image_raw": "rgb8"}
    path = colour_only(tmp_path, topics, K=K, size=SIZE, distortion=values, model=model)
    recording = opened(path).recording
    assert recording.distortion == expected
    assert recording.fisheye == fisheye


@pytest.mark.parametrize(
    ("model", "values"), [("Inverse Brown Conrady", [0.1] * 5), ("rational_polynomial", [0.1] * 12)]
)
def test_other_distortion_is_refused(tmp_path, model, values):
    topics = {"/camera/image_raw": "rgb8"}
    path = colour_only(tmp_path, topics, K=K, size=SIZE, distortion=values, model=model)
    with pytest.raises(DatasetError, match="record rectified images"):
        opened(path)


def test_without_camera_info_a_file_beside_the_bag_has_the_intrinsics(tmp_path):
    path = colour_only(tmp_path, {"/camera/image_raw": "rgb8"})
    assert not opened(path).recording.calibrated
    text = "fx: 40\nfy: 41\ncx: 15\ncy: 11\nwidth: 32\nheight: 24\nfisheye: [0.1, 0, 0, 0]\n"
    path.with_suffix(".yaml").write_text(text)
    recording = opened(path).recording
    assert recording.calibrated
    assert recording.fisheye
    assert recording.camera.fx == 40.0
    path.with_suffix(".yaml").write_text(text.replace("width: 32", "width: 33"))
    with pytest.raises(DatasetError, match="is for 33x24 pixels"):
        opened(path)


def test_depth_needs_intrinsics(tmp_path):
    content = BagContent()
    content.image(COLOUR, START_S, rgb(0), "rgb8")
    content.image(DEPTH, START_S, depth_mm(0), "16UC1")
    path = content.write(tmp_path)
    with pytest.raises(DatasetError, match="has no intrinsics; add them"):
        open_dataset("bag", path)
    dataset = open_dataset("bag", path, options=DatasetOptions(fov_deg=90.0))
    assert dataset.camera.fx == pytest.approx(16.0)


def test_messages_without_stamps_take_the_time_of_recording(tmp_path):
    content = BagContent()
    for i in range(3):
        content.image(COLOUR, START_S + min(i, 1), rgb(i), "rgb8", stamp_s=0.0)
    dataset = opened(content.write(tmp_path))
    np.testing.assert_allclose(dataset.timestamps_s, [100.0, 101.0, 101.000001], atol=1e-7)
    assert [round(255 * dataset[i].rgb[0, 0, 0]) for i in (2, 1, 0)] == [grey(2), grey(1), grey(0)]


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_bag_is_reported_in_one_line(tmp_path, storage, kept):
    path = write_rgbd(tmp_path, storage)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    content = file.read_bytes()
    file.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(DatasetError, match=r"damaged|no messages") as refusal:
        for _ in opened(path):
            pass
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [("notes.txt", "is not a bag"), ("empty", "contains no bag"), ("none", "does not exist")],
)
def test_other_paths_are_refused(tmp_path, name, message):
    (tmp_path / "notes.txt").write_text("no bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=message):
        opened(tmp_path / name)


def test_a_missing_package_is_named_with_the_command(tmp_path, monkeypatch):
    path = write_rgbd(tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(DependencyError, match=r"pip install 'semsplat\[bags\]'"):
        opened(path)


def test_a_bag_without_images_lists_its_topics(tmp_path):
    content = BagContent()
    content.number("/temperature", 20.0)
    with pytest.raises(DatasetError, match=r"no colour images; its topics are /temperature"):
        opened(content.write(tmp_path))
