"""Cameras of recordings in TUM's layout, and the lists of benchmarks that share it."""

import numpy as np
import pytest

from toolkit.base.errors import DatasetError
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io.images import read_rgb, write_rgb

INTRINSICS = "fx: 20.5\nfy: 20.5\ncx: 15.5\ncy: 11.5\nwidth: 640\nheight: 480\ndepth_scale: 1000\n"


@pytest.mark.parametrize("name", ["desk", "rgbd_dataset_freiburg1_desk"])
def test_a_stated_camera_counts_more_than_the_name(make_tum, name):
    folder = make_tum(name=name)
    (folder / "intrinsics.yaml").write_text(INTRINSICS + "readout_ms: 20\n")
    recording = describe("tum", folder)
    assert (recording.camera.fx, recording.camera.cx) == (20.5, 15.5)
    assert (recording.depth_scale, recording.distortion) == (1000.0, None)
    assert recording.readout_s == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("name", "start_s", "fx"),
    [
        ("rgbd_bonn_balloon", 1548266469.0, 542.823),
        ("rgbd_dataset_freiburg1_xyz", 1305031102.0, 517.3),
        ("rgbd_dataset_freiburg2_xyz", 1311867170.0, 520.9),
    ],
)
def test_benchmarks_are_known_by_their_names(make_tum, name, start_s, fx):
    recording = describe("tum", make_tum(name=name, start_s=start_s))
    assert (recording.camera.fx, recording.depth_scale) == (fx, 5000.0)


@pytest.mark.parametrize(
    ("name", "start_s", "said"),
    [
        ("rgbd_dataset_freiburg1_xyz", 1764400000.0, "times from 1300000000 to 1350000000 s"),
        ("bonn_office", 0.0, "times from 1530000000 to 1560000000 s, not 0"),
        ("my_living_room", 0.0, "one list of pairs of images, not two lists"),
    ],
)
def test_a_name_does_not_count_against_the_data(make_tum, name, start_s, said):
    with pytest.raises(DatasetError, match=said) as raised:
        describe("tum", make_tum(name=name, start_s=start_s))
    assert "intrinsics.yaml" in str(raised.value)


def test_a_name_does_not_count_for_images_of_another_size(make_tum):
    folder = make_tum()
    for file in (folder / "rgb").iterdir():
        write_rgb(file, read_rgb(file)[:240, :320])
    with pytest.raises(DatasetError, match=r"freiburg3 .* images of 640x480, not 320x240"):
        describe("tum", folder)


def test_the_own_name_of_a_link_counts(make_tum, tmp_path):
    folder = make_tum(name="disk7")
    link = tmp_path / "freiburg3_link"
    link.symlink_to(folder)
    assert describe("tum", link).camera.fx == 535.4
    with pytest.raises(DatasetError, match=r"the camera of .* is unknown"):
        describe("tum", folder)


def test_eth3d_states_its_camera_in_a_text(make_tum):
    folder = make_tum(name="cables_1")
    (folder / "calibration.txt").write_text("726.3 726.4 354.6 186.5\n")
    camera = describe("tum", folder).camera
    assert (camera.fx, camera.cy, camera.size) == (726.3, 186.5, (640, 480))


def test_openloris_has_lists_of_other_names(make_tum):
    folder = make_tum(name="cafe1-1")
    (folder / "rgb.txt").rename(folder / "color.txt")
    (folder / "depth.txt").rename(folder / "aligned_depth.txt")
    recording = describe("tum", folder)
    assert (recording.camera.fx, recording.depth_scale) == (611.451, 1000.0)
    assert len(recording.files) == 4


def test_icl_nuim_has_one_list_with_numbers_of_frames_and_poses_with_y_up(make_tum):
    folder = make_tum(name="living_room_traj0_frei_png")
    rgb, depth = (sorted((folder / kind).iterdir()) for kind in ("rgb", "depth"))
    lines = [f"{k} depth/{depth[k].name} {k} rgb/{rgb[k].name}" for k in range(4)]
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (folder / name).unlink()
    (folder / "associations.txt").write_text("\n".join(lines))
    half = np.radians(10.0) / 2
    poses = [f"{k} 0 {0.1 * k} 0 {np.sin(half)} 0 0 {np.cos(half)}" for k in range(4)]
    (folder / "livingRoom0.gt.freiburg").write_text("\n".join(poses))
    dataset = open_dataset("tum", folder, image_size=(32, 24))
    assert rgb == [dataset.files(k).rgb for k in range(4)]
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(4) / 30)
    truth = dataset.ground_truth.T_world_camera
    # In a world whose y axis points down, the camera moves and turns the other way.
    np.testing.assert_allclose(truth[:, 1, 3], -0.1 * np.arange(4), atol=1e-9)
    assert truth[0, 2, 1] == pytest.approx(-np.sin(2 * half))
