"""Labels of the data set, and from a folder of PNG files."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.io.images import write_png
from toolkit.semantics.segmenters.dataset_labels import RecordedLabels
from toolkit.semantics.segmenters.image_folder import LabelImageFolder

WIDTH, HEIGHT = 16, 12
CAMERA = Camera(20.0, 20.0, 7.5, 5.5, WIDTH, HEIGHT)
NAMES = {1: "wall", 2: "chair", 300: "lamp"}


def frame(index: int = 0, labels: np.ndarray | None = None) -> Frame:
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    return Frame(index, index / 30.0, rgb, np.ones((HEIGHT, WIDTH), np.float32), CAMERA, labels)


def some_labels(seed: int = 0) -> np.ndarray:
    ids = np.array([0, *NAMES], np.int32)
    return np.random.default_rng(seed).choice(ids, (HEIGHT, WIDTH))


@pytest.fixture
def make_folder(tmp_path) -> Callable[..., Path]:
    """Writes label images by file name, and `classes.json`."""

    def make(images: dict[str, np.ndarray], classes: object = None) -> Path:
        folder = tmp_path / "labels"
        folder.mkdir(exist_ok=True)
        for name, image in images.items():
            small = image.max() < 256
            write_png(folder / name, image.astype(np.uint8 if small else np.uint16))
        content = classes or {"void": 0, "classes": {str(k): v for k, v in NAMES.items()}}
        (folder / "classes.json").write_text(json.dumps(content))
        return folder

    return make


def test_recorded_labels_are_handed_on():
    labels = some_labels()
    segmenter = RecordedLabels(NAMES)
    np.testing.assert_array_equal(segmenter.segment(frame(labels=labels)), labels)
    assert segmenter.class_names == NAMES
    assert segmenter.state() == {}


def test_a_frame_without_labels_is_void_and_warns_once(caplog):
    segmenter = RecordedLabels(NAMES)
    with caplog.at_level(logging.WARNING):
        assert not segmenter.segment(frame(7)).any()
        assert not segmenter.segment(frame(8)).any()
    assert [r.message for r in caplog.records] == [
        "Frame 7 has no label image; frames without one are treated as void."
    ]


@pytest.mark.parametrize("wrong", [-1, 3, 299, 301, 70000])
def test_an_id_without_a_name_is_an_error_with_frame_and_id(wrong):
    labels = some_labels()
    labels[3, 4] = wrong
    with pytest.raises(
        DatasetError, match=rf"frame 5 contains class id\(s\) {wrong} without a name"
    ):
        RecordedLabels(NAMES).segment(frame(5, labels))


@pytest.mark.parametrize("names", [{}, {0: "void", 1: "wall"}])
def test_a_vocabulary_needs_names_above_void(names):
    with pytest.raises(DatasetError, match=r"classes\.json"):
        RecordedLabels(names)


def test_files_pair_by_the_last_number_in_their_names(make_folder):
    images = {f"cam1_label{i:06d}.png": some_labels(i) for i in range(3)}
    segmenter = LabelImageFolder(make_folder(images))
    for i in range(3):
        np.testing.assert_array_equal(segmenter.segment(frame(i)), some_labels(i))


def test_files_pair_by_the_stems_of_the_frames(make_folder):
    images = {"b.png": some_labels(1), "a.png": some_labels(2)}
    segmenter = LabelImageFolder(make_folder(images), stems=["b", "a"])
    np.testing.assert_array_equal(segmenter.segment(frame(0)), some_labels(1))
    np.testing.assert_array_equal(segmenter.segment(frame(1)), some_labels(2))


@pytest.mark.parametrize(
    ("files", "stems", "named"),
    [
        ({"1.png": 1, "2.png": 1}, None, "numbers start at 1, but frame indices start at 0"),
        ({"wall.png": 1}, None, "wall.png has no number"),
        ({"a0.png": 1, "b0.png": 1}, None, "b0.png and a0.png both have number 0"),
        ({"x0.png": 1}, ["frame0"], r"expected for instance frame0, found x0"),
        ({}, None, "contains no PNG file"),
    ],
)
def test_files_that_cannot_be_paired_are_named(make_folder, files, stems, named):
    folder = make_folder({name: some_labels() for name in files})
    with pytest.raises(DatasetError, match=named):
        LabelImageFolder(folder, stems)


def test_a_missing_file_is_an_error_unless_gaps_are_allowed(make_folder, caplog):
    folder = make_folder({"0.png": some_labels()})
    with pytest.raises(DatasetError, match=r"no label image for frame 1; add it, or set .*gaps"):
        LabelImageFolder(folder).segment(frame(1))
    allowed = LabelImageFolder(folder, gaps=True)
    assert not allowed.segment(frame(1)).any()
    assert not allowed.segment(frame(2)).any()
    assert len(caplog.records) == 1


@pytest.mark.parametrize("factor", [2, 3])
def test_larger_labels_are_sampled_at_pixel_centres(make_folder, factor):
    labels = some_labels()
    # Only the samples at the centres are right: any other choice is seen.
    large = np.full((HEIGHT * factor, WIDTH * factor), 2, np.int32)
    large[factor // 2 :: factor, factor // 2 :: factor] = labels
    found = LabelImageFolder(make_folder({"0.png": large})).segment(frame())
    np.testing.assert_array_equal(found, labels)


def test_smaller_labels_are_enlarged(make_folder):
    labels = some_labels()[::2, ::2]
    found = LabelImageFolder(make_folder({"0.png": labels})).segment(frame())
    np.testing.assert_array_equal(found, labels.repeat(2, axis=0).repeat(2, axis=1))


@pytest.mark.parametrize("shape", [(12, 12), (12, 20), (16, 12), (24, 30)])
def test_another_aspect_ratio_is_an_error_with_the_file(make_folder, shape):
    folder = make_folder({"0.png": np.ones(shape, np.int32)})
    with pytest.raises(DatasetError, match=r"0\.png is \d+x\d+, which does not scale to .* 16x12"):
        LabelImageFolder(folder).segment(frame())


def test_a_truncated_file_and_a_wrong_id_are_named(make_folder):
    folder = make_folder({"0.png": some_labels(), "1.png": np.full((HEIGHT, WIDTH), 9)})
    segmenter = LabelImageFolder(folder)
    with pytest.raises(DatasetError, match=r"1\.png contains class id\(s\) 9 without a name"):
        segmenter.segment(frame(1))
    (folder / "0.png").write_bytes((folder / "0.png").read_bytes()[:-20])
    with pytest.raises(DatasetError, match=r"0\.png is truncated"):
        segmenter.segment(frame(0))


COLOURED = {
    "void": 0,
    "classes": {"1": "wall", "2": "chair"},
    "colours": {"1": [255, 0, 0], "2": [0, 128, 255]},
}


def test_colours_become_ids_and_black_is_void(make_folder):
    ids = np.random.default_rng(0).integers(0, 3, (HEIGHT, WIDTH))
    palette = np.array([[0, 0, 0], [255, 0, 0], [0, 128, 255]])
    folder = make_folder({"0.png": palette[ids]}, COLOURED)
    np.testing.assert_array_equal(LabelImageFolder(folder).segment(frame()), ids)


def test_a_colour_of_no_class_is_an_error_with_its_place(make_folder):
    image = np.zeros((HEIGHT, WIDTH, 3), int)
    image[2, 5] = 254, 0, 0
    folder = make_folder({"0.png": image}, COLOURED)
    with pytest.raises(DatasetError, match=r"\[254, 0, 0\] at column 5, row 2"):
        LabelImageFolder(folder).segment(frame())


def test_coloured_files_without_a_table_are_no_label_images(make_folder):
    folder = make_folder({"0.png": np.ones((HEIGHT, WIDTH, 3), int)})
    with pytest.raises(DatasetError, match=r"0\.png is not a label image: 3 channel"):
        LabelImageFolder(folder).segment(frame())


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("{", "is not of the form"),
        ('{"classes": {"1": "a", "1": "b"}}', "'1' is given twice"),
        ('{"classes": {"01": "a"}}', "'01' is not a class id"),
        ('{"classes": {"1": ""}}', "class 1 must have a name"),
        ('{"classes": {"0": "wall", "1": "a"}}', "0 is void, so it cannot be 'wall'"),
        ('{"classes": ["a"]}', "'classes' must be a mapping"),
        ('{"void": 255, "classes": {"1": "a"}}', "void is 255, but must be 0"),
        ('{"classes": {}}', "names no classes"),
        ('{"classes": {"1": "a"}, "colours": {"1": [1, 2]}}', r"the colour of class 1 is \[1, 2\]"),
        ('{"classes": {"1": "a"}, "colours": {"1": [0, 0, 0]}}', "class 1 is black"),
        ('{"classes": {"1": "a"}, "colours": {"2": [9, 0, 0]}}', r"id\(s\) 2 without a name"),
        (
            '{"classes": {"1": "a", "2": "b"}, "colours": {"1": [9, 0, 0], "2": [9, 0, 0]}}',
            "class 2 has the colour of another",
        ),
    ],
)
def test_a_wrong_table_of_classes_is_named(make_folder, content, named):
    folder = make_folder({"0.png": some_labels()})
    (folder / "classes.json").write_text(content)
    with pytest.raises(DatasetError, match=named) as error:
        LabelImageFolder(folder)
    assert "classes.json" in str(error.value)


def test_a_folder_without_a_table_or_that_is_none_is_named(make_folder, tmp_path):
    folder = make_folder({"0.png": some_labels()})
    (folder / "classes.json").unlink()
    with pytest.raises(DatasetError, match=r"cannot read .*classes\.json"):
        LabelImageFolder(folder)
    with pytest.raises(DatasetError, match="is not a folder"):
        LabelImageFolder(tmp_path / "nothing")
