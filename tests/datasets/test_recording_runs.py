"""`semsplat run` on a recording of each kind, and what it says about wrong input."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import test_colmap_models
import test_record3d
from test_bags import write_rgbd
from test_photos import write_photo

from toolkit.datasets.options import DatasetKind
from toolkit.tools.cli.main import main

# Kinds that are colour with or without depth, by their fixtures.
RGBD = {
    "tum": "make_tum",
    "replica": "make_replica",
    "synthetic": "make_replica",
    "seven-scenes": "make_seven_scenes",
    "scannet": "make_scannet",
    "nerfstudio": "make_nerfstudio",
    "stray-scanner": "make_stray_scanner",
    "polycam": "make_polycam",
    "folder": "make_folder",
}


def write_photos(folder: Path) -> Path:
    for index in range(3):
        pixels = np.random.default_rng(index).integers(0, 255, (24, 32, 3)).astype(np.uint8)
        write_photo(folder / f"{index}.jpg", pixels, equivalent_mm=26)
    return folder


def write_film(folder: Path) -> Path:
    path = folder / "film.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 25.0, (64, 48))
    for index in range(3):
        writer.write(np.full((48, 64, 3), 40 * index, np.uint8))
    writer.release()
    return path


OTHERS = {
    "bag": write_rgbd,
    "record3d": test_record3d.write,
    "colmap": test_colmap_models.write,
    "images": write_photos,
    "video": write_film,
}


def run(kind: str, path: Path, out: Path, *more: str) -> int:
    place = ["--dataset.kind", kind, "--dataset.path", str(path)]
    return main(["run", *place, "--out", str(out), *more])


def error_of(capsys, kind: str, path: Path, *more: str) -> str:
    """The only line of an error, checking the exit status."""
    capsys.readouterr()
    assert run(kind, path, path.parent / "out", *more) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


@pytest.fixture
def recording(request, tmp_path) -> Path:
    """A recording of the kind that is the parameter."""
    if request.param in RGBD:
        return request.getfixturevalue(RGBD[request.param])()
    folder = tmp_path / "recording"
    folder.mkdir()
    return OTHERS[request.param](folder)


def test_every_kind_is_tried():
    assert set(get_args(DatasetKind)) == RGBD.keys() | OTHERS.keys()


@pytest.mark.parametrize(
    ("recording", "kind"),
    [(kind, kind) for kind in get_args(DatasetKind)],
    indirect=["recording"],
)
def test_every_kind_runs_without_depth(recording, kind, tmp_path):
    """The frames are random: it is said that the motion cannot be determined."""
    out = tmp_path / "out"
    assert run(kind, recording, out, "--depth", "none", "--image-size", "32", "24") == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"]["total"] >= 3
    assert metrics["monocular"]["reliable"] is False
    assert "could not be determined" in metrics["monocular"]["doubts"]


@pytest.mark.parametrize("kind", list(get_args(DatasetKind)))
def test_other_paths_give_one_line(capsys, kind, tmp_path):
    error = error_of(capsys, kind, tmp_path / "none", "--depth", "none")
    assert "none" in error
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    (wrong / "notes.txt").write_text("something else")
    error = error_of(capsys, kind, wrong, "--depth", "none")
    assert str(wrong) in error


@pytest.mark.parametrize("kind", ["bag", "record3d", "video", "images"])
def test_other_files_give_one_line(capsys, kind, tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("something else\n")
    assert str(file) in error_of(capsys, kind, file, "--depth", "none")


@pytest.mark.parametrize("kind", ["images", "video", "colmap"])
def test_colour_alone_needs_the_option(capsys, kind, tmp_path):
    error = error_of(capsys, kind, OTHERS[kind](tmp_path))
    assert "has no depth images" in error
    assert "--depth none" in error


def test_a_truncated_bag_gives_one_line(capsys, tmp_path):
    path = write_rgbd(tmp_path, "ros1")
    path.write_bytes(path.read_bytes()[:3000])
    assert "recording.bag is damaged" in error_of(capsys, "bag", path, "--depth", "none")


def test_intrinsics_that_lack_a_value_give_one_line(capsys, make_folder, make_polycam):
    folder = make_folder()
    text = (folder / "intrinsics.yaml").read_text().replace("fx: 30.0\n", "")
    (folder / "intrinsics.yaml").write_text(text)
    assert "lacks the key fx" in error_of(capsys, "folder", folder)
    camera = next((make_polycam() / "keyframes/corrected_cameras").iterdir())
    shutil.copy(folder / "intrinsics.yaml", camera)
    assert "must be JSON" in error_of(capsys, "polycam", camera.parents[2])


def test_a_calibrated_recording_refuses_a_field_of_view(capsys, tmp_path):
    path = test_colmap_models.write(tmp_path)
    error = error_of(capsys, "colmap", path, "--depth", "none", "--dataset.fov-deg", "60")
    assert "remove the field of view" in error


def test_topics_of_a_bag_are_options(capsys, tmp_path):
    path = write_rgbd(tmp_path)
    error = error_of(capsys, "bag", path, "--dataset.topics.colour", "/none")
    assert "has no topic /none with colour images" in error
