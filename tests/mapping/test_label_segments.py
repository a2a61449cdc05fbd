"""Connected segments of label images, and their correction by the map."""

from __future__ import annotations

import shutil

import numpy as np

import toolkit
from toolkit.io.images import write_png
from toolkit.slam.mapping.consensus import connected_segments


def test_every_connected_area_is_one_segment_of_its_class():
    labels = np.array(
        [
            [4, 4, 0, 7, 7],
            [4, 0, 0, 0, 7],
            [0, 0, 4, 0, 0],
            [4, 0, 0, 0, 4],
        ]
    )
    segments, classes = connected_segments(labels)
    assert np.array_equal(classes[segments], labels)
    assert np.unique(segments).tolist() == list(range(len(classes)))
    assert sorted(classes.tolist()) == [0, 4, 4, 4, 4, 7]
    sizes = sorted(zip(classes.tolist(), np.bincount(segments.ravel()).tolist(), strict=True))
    assert sizes == [(0, 11), (4, 1), (4, 1), (4, 1), (4, 3), (7, 3)]


def test_a_map_of_void_labels_is_finished_without_any(tiny_recording, tmp_path):
    """No class is observed, so there is nothing that a segment could be corrected to."""
    place = shutil.copytree(tiny_recording, tmp_path / "recording")
    for file in (place / "labels").glob("*.png"):
        write_png(file, np.zeros((48, 64), np.uint8))
    dataset = toolkit.open_dataset("folder", place, max_frames=2)
    slam = toolkit.build_slam(dataset, toolkit.RunSettings())
    for frame in dataset:
        slam.process_frame(frame)
    assert len(slam.finish().gaussians) > 100
