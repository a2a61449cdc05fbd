"""Real recordings have the expected frames, cameras and depths."""

import cv2
import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import open_dataset

RECORDINGS = [
    ("tum", "tum_fr1_rpy", 120, 517.3),
    ("replica", "replica_office0", 51, 300.0),
    ("seven-scenes", "7scenes_redkitchen", 200, 527.0),
]


@pytest.mark.parametrize(("kind", "name", "frames", "fx"), RECORDINGS)
def test_frames_camera_truth(real_data, kind, name, frames, fx):
    dataset = open_dataset(kind, real_data(name))
    assert len(dataset) == len(dataset.ground_truth) == frames
    assert dataset.camera.fx == fx
    assert dataset.recording.flaws == ()
    for frame in prefetched(dataset, range(0, frames, frames // 3)):
        assert frame.rgb.std() > 0.05
        assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 4.0


def test_a_bag_of_a_tracking_camera_gives_undistorted_images(real_data):
    """The left edge of the door is straight, as it is not in the image of the fisheye."""
    pytest.importorskip("rosbags")
    path = real_data("recordings") / "trimmed_locoffice.bag"
    dataset = open_dataset("bag", path, image_size=(848, 800), needs_depth=False)
    assert len(dataset) == 3
    assert dataset.camera.size == (848, 800)
    assert dataset.timestamps_s[0] == pytest.approx(1553180224.360916)
    assert dataset.recording.fisheye
    assert not dataset.recording.calibrated
    assert dataset.recording.container is not None
    assert bend_px(dataset[1].rgb) < 0.7
    assert bend_px(dataset.recording.container.rgb(1)) > 1.0


def bend_px(rgb: np.ndarray) -> float:
    """Largest distance of the steepest step near the edge of the door from a straight line."""
    rows, left = np.arange(270, 630, 10), 365
    smooth = cv2.GaussianBlur(rgb[..., 0], (0, 0), 1.5)[rows, left : left + 37]
    columns = np.abs(np.diff(smooth, axis=1)).argmax(axis=1)
    line = np.polyval(np.polyfit(rows, columns, 1), rows)
    return float(np.abs(columns - line).max())


@pytest.mark.parametrize(("kind", "name", "frames", "fx"), RECORDINGS)
def test_depth_reprojected_to_the_next_view_agrees(real_data, kind, name, frames, fx):
    """Scale, intrinsics, resizing and direction of the poses are consistent."""
    dataset = open_dataset(kind, real_data(name), image_size=(320, 240))
    i, j = frames // 2, frames // 2 + 2
    here, there = dataset[i], dataset[j]
    poses = dataset.ground_truth.T_world_camera
    T_there_here = se3.inverse(poses[j]) @ poses[i]
    points = dataset.camera.unproject(here.depth_m)[here.depth_m > 0]
    moved = se3.transform_points(T_there_here, points)
    moved = moved[moved[:, 2] > 0.1]
    pixels = np.rint(dataset.camera.project(moved)).astype(int)
    inside = ((pixels >= 0) & (pixels < dataset.camera.size)).all(axis=1)
    measured = there.depth_m[pixels[inside, 1], pixels[inside, 0]]
    difference = np.abs(measured - moved[inside, 2])[measured > 0]
    assert difference.size > 10_000
    assert np.median(difference) < (0.002 if name == "replica_office0" else 0.02)


def test_replica_labels_have_names(real_data):
    dataset = open_dataset("replica", real_data("replica_office0"), image_size=(320, 240))
    seen = set(np.unique(dataset[0].labels)) - {0}
    assert seen
    assert seen <= set(dataset.label_names)
