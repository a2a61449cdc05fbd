"""Recordings of Stray Scanner: a video, depth images and a table of poses."""

from __future__ import annotations

import numpy as np
import pytest
from film_boxes import change, turned_upright
from test_formats import check_truth, depth_of

from toolkit.base.errors import DatasetError, FormatError
from toolkit.datasets.checks import check_recording
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io import images
from toolkit.io.video import VideoFile


def grey(dataset, index: int) -> float:
    return float(dataset[index].rgb.mean())


def test_frames_camera_and_poses_are_those_written(make_stray_scanner):
    dataset = open_dataset("stray-scanner", make_stray_scanner())
    assert len(dataset) == 6
    check_truth(dataset, list(range(6)), list(range(6)))
    assert dataset.recording.up_world == (0.0, 1.0, 0.0)
    camera = dataset.camera  # a quarter of the video, whose centre is (64, 48) from its corner
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 31.0, 15.5, 11.5)
    for i in range(6):
        frame = dataset[i]
        assert frame.rgb.shape == (24, 32, 3)
        assert grey(dataset, i) == pytest.approx(0.1 + 0.1 * i, abs=0.02)
        assert frame.timestamp_s == pytest.approx(100.0 + i / 60)
        expected = depth_of(i).astype(np.float32)
        expected[3, 5] = 0.0  # no confidence
        np.testing.assert_allclose(frame.depth_m, expected, atol=0.001)


def test_the_rotation_of_the_video_is_not_applied(make_stray_scanner):
    """Depth and intrinsics are for the pixels of the sensor."""
    folder = make_stray_scanner()
    upright = turned_upright(96)
    change(folder / "rgb.mp4", upright)
    assert VideoFile(folder / "rgb.mp4").size == (96, 128)
    dataset = open_dataset("stray-scanner", folder)
    assert dataset.camera.size == (32, 24)
    assert dataset.camera.fx == pytest.approx(30.0)
    assert grey(dataset, 3) == pytest.approx(0.4, abs=0.02)
    alone = open_dataset("stray-scanner", folder, needs_depth=False)
    assert alone[3].rgb.shape == (96, 128, 3)


def test_without_depth_colour_keeps_its_size(make_stray_scanner):
    dataset = open_dataset("stray-scanner", make_stray_scanner(), needs_depth=False)
    assert dataset.camera.size == (128, 96)
    assert (dataset.camera.fx, dataset.camera.cx) == (120.0, 63.5)
    frame = dataset[2]
    assert frame.rgb.shape == (96, 128, 3)
    assert frame.depth_m[3 * 4 + 1, 5 * 4 + 2] == 0.0  # no confidence
    assert frame.depth_m[0, 0] == pytest.approx(depth_of(2)[0, 0], abs=1e-3)


def test_any_order_of_access_gives_the_same_frames(make_stray_scanner):
    dataset = open_dataset("stray-scanner", make_stray_scanner())
    shuffled = {i: dataset[i].rgb for i in (4, 1, 5, 0, 5)}
    again = open_dataset("stray-scanner", dataset.recording.files[0].rgb.parent)
    for i, rgb in shuffled.items():
        np.testing.assert_array_equal(rgb, again[i].rgb)


def test_rows_without_depth_are_left_out_with_their_video_frames(make_stray_scanner):
    folder = make_stray_scanner()
    (folder / "depth/000002.png").unlink()
    dataset = open_dataset("stray-scanner", folder)
    assert [round(10 * grey(dataset, i)) for i in range(5)] == [1, 2, 4, 5, 6]
    check_truth(dataset, list(range(5)), [0, 1, 3, 4, 5])
    assert dataset.recording.flaws == ("1 row(s) of odometry.csv without a depth image: 2",)
    assert dataset.stems == ["000000", "000001", "000003", "000004", "000005"]


def test_without_confidence_all_depth_counts(make_stray_scanner):
    folder = make_stray_scanner()
    for file in (folder / "confidence").iterdir():
        file.unlink()
    assert open_dataset("stray-scanner", folder)[0].depth_m[3, 5] > 0


def test_a_short_video_is_reported_by_its_frame(make_stray_scanner):
    folder = make_stray_scanner(video_frames=3)
    dataset = open_dataset("stray-scanner", folder)
    with pytest.raises(DatasetError, match=r"rgb\.mp4 ends or is damaged after frame 2"):
        dataset[4]
    report = check_recording(describe("stray-scanner", folder))
    assert any("rgb.mp4" in fault for fault in report.faults)


@pytest.mark.parametrize("content", [b"", b"not a video" * 100])
def test_a_file_that_is_no_video_is_refused_in_one_line(make_stray_scanner, content, capfd):
    folder = make_stray_scanner()
    (folder / "rgb.mp4").write_bytes(content)
    capfd.readouterr()
    with pytest.raises(DatasetError, match=r"rgb\.mp4 is damaged or not a video"):
        open_dataset("stray-scanner", folder)
    assert capfd.readouterr() == ("", "")


def test_a_missing_video_names_the_file(tmp_path):
    with pytest.raises(DatasetError, match=r"none\.mp4: no such file"):
        VideoFile(tmp_path / "none.mp4")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("qw\n", "w\n", "line 1: the header lacks qw"),
        ("100.0, 000000", "now, 000000", "line 2"),
        (", 000001,", "", "line 3"),
    ],
)
def test_a_malformed_table_is_refused_by_line(make_stray_scanner, old, new, message):
    folder = make_stray_scanner()
    file = folder / "odometry.csv"
    file.write_text(file.read_text().replace(old, new, 1))
    with pytest.raises(FormatError, match=message):
        open_dataset("stray-scanner", folder)


def test_no_pair_of_row_and_depth_is_refused(make_stray_scanner):
    folder = make_stray_scanner(frames=1)
    (folder / "depth/000000.png").rename(folder / "depth/000007.png")
    with pytest.raises(DatasetError, match=r"no depth image with the number of a row"):
        open_dataset("stray-scanner", folder)


def test_confidence_of_another_size_is_refused(make_stray_scanner):
    folder = make_stray_scanner(frames=1)
    images.write_png(folder / "confidence/000000.png", np.ones((5, 5), np.uint8))
    with pytest.raises(DatasetError, match=r"000000\.png is 5x5"):
        open_dataset("stray-scanner", folder)


@pytest.mark.parametrize("time_s", ["same", "earlier"])
def test_times_that_do_not_increase_are_refused_in_one_line(make_stray_scanner, time_s):
    folder = make_stray_scanner(frames=3)
    file = folder / "odometry.csv"
    header, first, second, third = file.read_text().splitlines()
    before = float(second.split(",")[0]) - (0.0 if time_s == "same" else 0.5)
    third = ",".join([str(before), *third.split(",")[1:]])
    file.write_text("\n".join([header, first, second, third]) + "\n")
    with pytest.raises(DatasetError, match=r"odometry.csv: times repeat or run backwards at"):
        open_dataset("stray-scanner", folder)
