"""Depth values that mean "no measurement" are found from the images, in any layout."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toolkit.datasets.base import FrameFiles, RecordedDataset
from toolkit.datasets.checks import check_recording
from toolkit.datasets.far_values import far_value
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io import images


def surfaces(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(800.0, 4000.0, (24, 32)).round()


def with_share(depth: np.ndarray, value: float, share: float) -> np.ndarray:
    changed = depth.copy()
    changed.flat[: round(share * depth.size)] = value
    return changed


@pytest.mark.parametrize("value", [8000.0, 10000.0, 60000.0])
def test_a_constant_value_far_behind_all_others_is_found(value):
    found = far_value([with_share(surfaces(i), value, 0.05) for i in range(4)])
    assert found.value == value
    assert found.share == pytest.approx(0.05, abs=0.003)


@pytest.mark.parametrize(
    "depths",
    [
        [surfaces(i) for i in range(4)],
        [with_share(surfaces(i), 7000.0, 0.3) for i in range(4)],  # a wall
        [with_share(surfaces(i), 8000.0 + 300 * i, 0.3) for i in range(4)],  # seen on the way
        [with_share(surfaces(0), 9000.0, 0.3), surfaces(1), surfaces(2)],  # in one frame
        [np.array([[2, 2, 4, 5]], np.uint16)] * 4,  # neighbouring values of few bits
        [np.full((24, 32), 3000.0)] * 4,
        [np.zeros((24, 32))] * 4,
        [],
    ],
)
def test_surfaces_are_none(depths):
    assert far_value(depths) is None


def rewrite_depth(folder: Path, value: int, share: float) -> None:
    for file in sorted((folder / "depth").iterdir()):
        depth = with_share(images.read_depth_values(file), value, share)
        images.write_png(file, depth.astype(np.uint16))


@pytest.mark.parametrize(
    ("value", "note"),
    [(65535, "10 % of the depth pixels have the largest value"), (60000, "one constant value of")],
)
def test_a_run_and_check_data_treat_it_as_missing_and_say_so(make_folder, caplog, value, note):
    folder = make_folder()
    rewrite_depth(folder, 0, 0.1)
    expected = open_dataset("folder", folder)[1].depth_m
    rewrite_depth(folder, value, 0.1)
    with caplog.at_level(logging.INFO):
        dataset = open_dataset("folder", folder)
    np.testing.assert_array_equal(dataset[1].depth_m, expected)
    assert caplog.text.count(note) == 1
    report = check_recording(describe("folder", folder))
    assert sum(note in line for line in report.notes) == 1


class FloatingPoint:
    """A container whose depth has values that no image file has."""

    def depth_m(self, number: int) -> np.ndarray:
        depth_m = np.full((24, 32), 2.0, np.float32)
        depth_m[0, :4] = [np.nan, np.inf, -np.inf, -1.0]
        depth_m.setflags(write=False)
        return depth_m

    def rgb(self, number: int) -> np.ndarray:
        return np.zeros((24, 32, 3), np.float32)


def test_depth_that_is_no_positive_number_is_missing(make_folder):
    recording = describe("folder", make_folder())
    camera = replace(recording.camera, width=32, height=24)
    files = tuple(replace(frame, number=k) for k, frame in enumerate(recording.files))
    assert all(isinstance(frame, FrameFiles) for frame in files)
    recording = replace(recording, camera=camera, files=files, container=FloatingPoint())
    depth_m = RecordedDataset(recording)[0].depth_m
    np.testing.assert_array_equal(depth_m[0, :5], [0.0, 0.0, 0.0, 0.0, 2.0])
