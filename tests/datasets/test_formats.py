"""Dataset layouts: frames, timestamps, camera and ground truth are read as written."""

import json
import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.geometry import se3
from toolkit.datasets.options import READERS, DatasetOptions
from toolkit.datasets.pairing import associate
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io import images


def rgb_of(index: int) -> np.ndarray:
    return np.random.default_rng(index).uniform(size=(24, 32, 3))


def depth_of(index: int) -> np.ndarray:
    return np.tile(np.linspace(1.0, 2.0, 32), (24, 1)) + 0.1 * index


def pose_of(index: int) -> np.ndarray:
    return se3.exp(np.array([0.1 * index, 0.0, 0.05 * index, 0.0, 0.02 * index, 0.0]))


def check_frames(dataset, numbers: list[int]) -> None:
    """Assert that the frames are those that the fixtures wrote for these numbers."""
    assert len(dataset) == len(numbers)
    times = [dataset[i].timestamp_s for i in range(len(dataset))]
    assert (np.diff(times) > 0).all()
    for i, number in enumerate(numbers):
        frame = dataset[i]
        assert frame.index == i
        assert frame.camera == dataset.camera
        np.testing.assert_allclose(frame.rgb, rgb_of(number), atol=0.003)
        missing = frame.depth_m == 0
        assert missing.sum() <= 2
        np.testing.assert_allclose(frame.depth_m[~missing], depth_of(number)[~missing], atol=0.001)


def check_truth(dataset, frames: list[int], numbers: list[int]) -> None:
    """Assert that ground truth exists for exactly these frames, with the poses of these numbers."""
    truth = dataset.ground_truth
    times = [dataset[i].timestamp_s for i in frames]
    np.testing.assert_array_equal(truth.timestamps_s, times)
    expected = [pose_of(number) for number in numbers]
    np.testing.assert_allclose(truth.T_world_camera, expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["replica", "synthetic"])
def test_replica(make_replica, kind):
    dataset = open_dataset(kind, make_replica(labels=True))
    check_frames(dataset, [0, 1, 2, 3])
    check_truth(dataset, [0, 1, 2, 3], [0, 1, 2, 3])
    assert dataset.label_names == {1: "wall", 2: "chair"}
    assert dataset[2].labels.max() == 2
    assert dataset.camera.fy == 31.0


def test_replica_pairs_by_number_and_finds_the_camera_in_the_parent(make_replica):
    folder = make_replica()
    (folder / "results/depth000001.png").unlink()
    (folder / "cam_params.json").rename(folder.parent / "cam_params.json")
    dataset = open_dataset("replica", folder)
    check_frames(dataset, [0, 2, 3])
    check_truth(dataset, [0, 1, 2], [0, 2, 3])
    assert dataset.recording.flaws == ("1 colour image(s) without depth: frame000001.png",)


@pytest.mark.parametrize("name", ["frame000002.jpg", "frame2.png"])
def test_two_images_of_one_number_are_refused(make_replica, name):
    folder = make_replica()
    shutil.copy(folder / "results/frame000000.png", folder / "results" / name)
    with pytest.raises(
        DatasetError, match=r"results contains both frame\S+ and frame\S+; keep one"
    ):
        open_dataset("replica", folder)


def test_replica_without_truth_or_labels(make_replica):
    folder = make_replica()
    (folder / "traj.txt").unlink()
    dataset = open_dataset("replica", folder)
    assert dataset.ground_truth is None
    assert dataset.label_names is None
    assert dataset[0].labels is None


def test_tum_associates_by_time(make_tum):
    folder = make_tum()
    for path in (folder, folder.parent):
        dataset = open_dataset("tum", path, image_size=(32, 24))
        assert dataset.name == folder.name
        check_frames(dataset, [0, 1, 2, 3])
        check_truth(dataset, [0, 1, 2, 3], [0, 1, 2, 3])
        assert dataset.camera.fx == pytest.approx(535.4 / 20)


def test_tum_interpolates_poses_in_time(make_tum):
    folder = make_tum()
    moving = [
        f"{1341840000.1 + offset_s:.3f} {offset_s} 0 0 0 0 {np.sin(half)} {np.cos(half)}"
        for offset_s, half in ((-0.004, -0.02), (0.006, 0.03))
    ]
    alone = "1341840000.31 5 0 0 0 0 0 1"
    (folder / "groundtruth.txt").write_text("\n".join([*moving, alone]))
    truth = open_dataset("tum", folder, image_size=(32, 24)).ground_truth
    # Of the two frames with a pose, one is between two poses, the other before a single one.
    np.testing.assert_allclose(truth.positions_m[:, 0], [0.0, 5.0], atol=1e-6)
    angles = [se3.rotation_angle_rad(T[:3, :3]) for T in truth.T_world_camera]
    np.testing.assert_allclose(angles, [0.0, 0.0], atol=1e-6)


def test_tum_omits_frames_without_depth_and_poses_without_ground_truth(make_tum):
    folder = make_tum()
    for name in ("depth.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(lines[:1] + lines[2:]))
    (folder / "groundtruth.txt").write_text(
        (folder / "groundtruth.txt").read_text().replace("\n1341840000.2", "\n1341840050.2")
    )
    dataset = open_dataset("tum", folder, image_size=(32, 24))
    check_frames(dataset, [1, 2, 3])
    check_truth(dataset, [0, 2], [1, 3])
    assert "without depth within 20 ms" in dataset.recording.notes[0]
    assert "without a ground-truth pose" in dataset.recording.notes[1]


def test_tum_without_any_pair_states_the_times(make_tum):
    folder = make_tum()
    lines = [line for line in (folder / "depth.txt").read_text().splitlines() if line[0] != "#"]
    late = [f"{float(time) + 5} {file}" for time, file in map(str.split, lines)]
    (folder / "depth.txt").write_text("\n".join(late))
    with pytest.raises(DatasetError, match=r"within 20 ms, rgb\.txt has times from .* s and depth"):
        open_dataset("tum", folder)


def test_tum_sorts_lists_and_reports_it(make_tum):
    folder = make_tum()
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([lines[0], lines[2], lines[1], *lines[3:]]))
    dataset = open_dataset("tum", folder, image_size=(32, 24))
    check_frames(dataset, [0, 1, 2, 3])
    assert dataset.recording.flaws == ("rgb.txt: timestamps out of order at 1341840000.000000.png",)


def test_tum_without_a_known_camera_raises(make_tum):
    with pytest.raises(DatasetError, match=r"write .*office/intrinsics.yaml with the keys fx"):
        open_dataset("tum", make_tum(name="office"))


def test_association_is_greedy_and_one_to_one():
    pairs = associate(np.array([0.0, 0.010, 0.5]), np.array([0.009, 0.012, 0.53]), 0.02)
    assert pairs == [(0, 1), (1, 0)]


def test_seven_scenes(make_seven_scenes, caplog):
    folder = make_seven_scenes()
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset("seven-scenes", folder)
    assert "585" in caplog.text
    assert dataset.camera.fx == 585
    check_frames(dataset, [0, 2, 4, 6])
    check_truth(dataset, [0, 1, 2, 3], [0, 2, 4, 6])
    assert dataset[1].depth_m[0, 0] == 0
    (folder / "camera-intrinsics.txt").write_text("30 0 15\n0 30 12\n0 0 1\n")
    assert open_dataset("seven-scenes", folder.parent).camera.fx == 30


def test_scannet_sorts_by_number_and_omits_infinite_poses(make_scannet):
    dataset = open_dataset("scannet", make_scannet())
    check_frames(dataset, list(range(12)))
    gone = [0, *range(2, 12)]
    check_truth(dataset, gone, gone)
    assert dataset.recording.notes == ("1 frame(s) with a non-finite ground-truth pose: 1.png",)
    assert dataset.recording.flaws == ()


def test_scannet_scales_the_colour_camera_if_depth_has_none(make_scannet):
    folder = make_scannet()
    K = np.diag([60.0, 62.0, 1.0, 1.0])
    K[:2, 2] = 31.5, 23.5
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", K)
    own = open_dataset("scannet", folder).camera
    (folder / "intrinsic/intrinsic_depth.txt").unlink()
    scaled = open_dataset("scannet", folder).camera
    assert (scaled.fx, scaled.fy, scaled.cx, scaled.cy) == (own.fx, own.fy, own.cx, own.cy)


def test_plain_folder(make_folder):
    dataset = open_dataset("folder", make_folder(frames=11))
    check_frames(dataset, list(range(11)))
    check_truth(dataset, list(range(11)), list(range(11)))
    assert dataset[3].timestamp_s == pytest.approx(0.3)


def test_rendered_images_have_no_rolling_shutter(make_seven_scenes, make_replica):
    assert describe("replica", make_replica()).readout_s == 0.0
    assert describe("seven-scenes", make_seven_scenes()).readout_s is None


def test_the_readout_of_a_rolling_shutter_can_be_specified(make_folder):
    folder = make_folder(intrinsics={"readout_ms": 20})
    whole = open_dataset("folder", folder)
    assert whole[0].readout_s == pytest.approx(0.02)
    options = DatasetOptions(readout_ms=12)
    assert open_dataset("folder", folder, options=options)[0].readout_s == pytest.approx(0.012)
    # Without depth, motion is estimated from the images as they are.
    without = open_dataset("folder", folder, needs_depth=False, options=options)
    assert without[0].readout_s == 0.0
    # A crop contains a part of the rows.
    width, height = whole.camera.size
    cropped = open_dataset("folder", folder, image_size=(2 * width, height))[0]
    assert cropped.readout_s == pytest.approx(0.01)


def test_times_of_a_plain_folder_can_be_specified(make_folder):
    folder = make_folder(frames=3)
    (folder / "timestamps.txt").write_text("0 0.01\n1 0.13\n2 7.5\n")
    dataset = open_dataset("folder", folder)
    assert dataset.timestamps_s.tolist() == [0.01, 0.13, 7.5]
    # Poses at 0, 0.1 and 0.2 s: the last one is not that of the last frame.
    check_truth(dataset, [0, 1], [0, 1])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0 0.0\n1 0.1\n", "lacks the frame 2"),
        ("0 0.0\n1 0.1\n2 0.1\n", "time of frame 2 must be finite and increase"),
        ("0 0.0\n1 nan\n2 0.2\n", "time of frame 1 must be finite and increase"),
        ("0 0.0\n1 0.1\n2\n", "must have a stem and seconds"),
        ("0 0.0\n1 0.1\n2 soon\n", "line 3: each line must have a stem and seconds"),
        ("0 0.0\n1 0.1\n2 0.2\n2 9.9\n", "line 4: frame 2 has two times"),
    ],
)
def test_errors_in_times_name_the_file(make_folder, content, message):
    folder = make_folder(frames=3)
    (folder / "timestamps.txt").write_text(content)
    with pytest.raises(DatasetError, match=message) as caught:
        open_dataset("folder", folder)
    assert "timestamps.txt" in str(caught.value)


def renamed(folder: Path, name: Callable[[str, int], str]) -> Path:
    """Rename the images of a folder by the name of their subfolder and their number."""
    for kind in ("rgb", "depth"):
        for file in list((folder / kind).iterdir()):
            file.rename(file.with_name(name(kind, int(file.stem))))
    return folder


@pytest.mark.parametrize("prefix", ["", "frame_", "my room 2, "])
def test_frames_of_a_plain_folder_are_in_the_order_of_their_numbers(make_folder, prefix):
    folder = renamed(make_folder(frames=12), lambda _, number: f"{prefix}{number}.png")
    check_frames(open_dataset("folder", folder), list(range(12)))


def test_times_may_have_comments_and_names_with_spaces(make_folder):
    folder = renamed(make_folder(frames=2), lambda _, number: f"my room {number}.png")
    (folder / "timestamps.txt").write_text("# stem seconds\nmy room 0 0.5\nmy room 1 0.75\n")
    assert open_dataset("folder", folder).timestamps_s.tolist() == [0.5, 0.75]


def test_a_plain_folder_without_pairs_says_why(make_folder):
    folder = renamed(make_folder(frames=2), lambda kind, number: f"{kind}_{number}.png")
    with pytest.raises(DatasetError, match=r"depth_0\.png, rgb_0\.png\); rename them"):
        open_dataset("folder", folder)
    for file in (folder / "depth").iterdir():
        file.rename(file.with_suffix(".npy"))
    with pytest.raises(DatasetError, match=r"depth contains no \.png images; convert depth"):
        open_dataset("folder", folder)
    for file in (folder / "rgb").iterdir():
        file.rename(file.with_suffix(".webp"))
    with pytest.raises(DatasetError, match="rgb contains no images"):
        open_dataset("folder", folder)


def test_two_images_of_one_frame_are_refused(make_folder):
    folder = make_folder(frames=2)
    shutil.copy(folder / "rgb/1.png", folder / "rgb/1.jpg")
    with pytest.raises(DatasetError, match=r"rgb contains both 1\.jpg and 1\.png; keep one"):
        open_dataset("folder", folder)


def test_a_folder_without_depth_has_colour_alone(make_folder):
    folder = make_folder(frames=3, intrinsics={"depth_scale": None})
    shutil.rmtree(folder / "depth")
    with pytest.raises(DatasetError, match="has no depth images"):
        open_dataset("folder", folder)
    dataset = open_dataset("folder", folder, needs_depth=False)
    assert len(dataset) == 3
    assert not dataset[2].depth_m.any()
    assert dataset.recording.flaws == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": None}, "lacks the key fx"),
        ({"focal": 3}, "unknown key 'focal'"),
        ({"depth_scale": 0}, "depth_scale must be positive"),
        ({"fx": "wide"}, "could not convert"),
        ({"fy": -1}, "fx, fy > 0"),
        ({"fx": "true"}, "fx must be a number, got True"),
        ({"width": 32.5}, "width must be a whole number of pixels"),
        ({"distortion": "[1, 2]"}, "distortion must be the 5 numbers"),
        ({"readout_ms": -3}, "readout_ms must be milliseconds"),
    ],
)
def test_errors_in_intrinsics_name_the_file_and_the_key(make_folder, change, message):
    with pytest.raises(DatasetError, match=message) as caught:
        open_dataset("folder", make_folder(intrinsics=change))
    assert "intrinsics.yaml" in str(caught.value)


def test_max_frames_also_limits_the_ground_truth(make_replica):
    dataset = open_dataset("replica", make_replica(), max_frames=2)
    assert len(dataset) == len(dataset.ground_truth) == 2
    with pytest.raises(IndexError):
        dataset[2]


@pytest.mark.parametrize("kind", READERS)
def test_errors_for_wrong_paths_and_empty_folders_are_one_line(tmp_path, kind):
    for path in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(DatasetError) as caught:
            open_dataset(kind, path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_error_for_an_unknown_kind_lists_the_supported_ones():
    with pytest.raises(DatasetError, match="tum, replica, seven-scenes"):
        open_dataset("kitti", "anywhere")


def test_empty_recordings_wrong_sizes_and_empty_depth_raise(make_replica, caplog):
    folder = make_replica()
    camera = json.loads((folder / "cam_params.json").read_text())
    (folder / "cam_params.json").write_text(
        json.dumps({"camera": camera["camera"] | {"w": 64, "h": 48}})
    )
    with pytest.raises(DatasetError, match=r"depth000000\.png is 32x24 .* 64x48"):
        open_dataset("replica", folder)
    (folder / "cam_params.json").write_text(json.dumps(camera))
    images.write_png(folder / "results/depth000000.png", np.zeros((24, 32), np.uint16))
    with caplog.at_level(logging.WARNING):
        assert not open_dataset("replica", folder)[0].depth_m.any()
    assert "the first 1 frame(s) have no depth; the map starts at frame 1" in caplog.text
    for file in (folder / "results").glob("depth*.png"):
        images.write_png(file, np.zeros((24, 32), np.uint16))
    with pytest.raises(DatasetError, match=r"depth000000\.png and all later depth images"):
        open_dataset("replica", folder)
    for file in (folder / "results").iterdir():
        file.unlink()
    with pytest.raises(DatasetError, match="contains no frames"):
        open_dataset("replica", folder)


def test_error_names_the_malformed_camera_file(make_replica):
    folder = make_replica()
    (folder / "cam_params.json").write_text('{"camera": {"w": 32}}')
    with pytest.raises(DatasetError, match=r"cam_params\.json must contain"):
        open_dataset("replica", folder)
    (folder / "cam_params.json").unlink()
    with pytest.raises(DatasetError, match=r"neither .* contains cam_params\.json"):
        open_dataset("replica", folder)


def test_error_names_the_malformed_pose_line(make_replica):
    folder = make_replica()
    (folder / "traj.txt").write_text("1 2 3\n")
    with pytest.raises(FormatError, match=r"traj\.txt, line 1"):
        open_dataset("replica", folder)


def test_error_names_the_damaged_frame_when_it_is_loaded(make_replica):
    folder = make_replica()
    file = folder / "results/frame000002.png"
    file.write_bytes(file.read_bytes()[:-20])
    dataset = open_dataset("replica", folder)
    dataset[1]
    with pytest.raises(DatasetError, match=r"frame000002\.png is truncated"):
        dataset[2]
