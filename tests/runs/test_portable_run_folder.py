"""A run folder works from every working directory, and for most programs without the dataset."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

import toolkit
from toolkit.tools.cli.main import main


def words_of_a_run(dataset: str, *more: str) -> list[str]:
    return ["run", "--dataset.kind", "folder", "--dataset.path", dataset, "--out", "run", *more]


@pytest.fixture
def relative_run(tiny_recording, tmp_path, monkeypatch) -> Path:
    """A run made with a relative dataset path, called from another working directory later."""
    shutil.copytree(tiny_recording, tmp_path / "a" / "mine")
    monkeypatch.chdir(tmp_path / "a")
    assert main(words_of_a_run("mine", "--max-frames", "2")) == 0
    (tmp_path / "b").mkdir()
    monkeypatch.chdir(tmp_path / "b")
    return tmp_path / "a" / "run"


def test_a_relative_dataset_path_works_from_another_directory(relative_run, capsys):
    assert main(["render", str(relative_run), "--what", "strip"]) == 0
    assert main(["query", str(relative_run)]) == 0
    assert main(["evaluate", str(relative_run)]) == 0
    assert capsys.readouterr().err == ""


def test_resume_accepts_the_same_dataset_given_relatively_or_absolutely(
    relative_run, tmp_path, monkeypatch, capsys
):
    trajectory = (relative_run / "trajectory.txt").read_bytes()
    (tmp_path / "link").symlink_to(tmp_path / "a")
    monkeypatch.chdir(tmp_path / "a")
    for path in (str(tmp_path / "a" / "mine"), "./mine", "../a/mine", str(tmp_path / "link/mine")):
        assert main(words_of_a_run(path, "--max-frames", "2", "--resume")) == 0, path
    assert (relative_run / "trajectory.txt").read_bytes() == trajectory
    assert main(words_of_a_run("../mine", "--max-frames", "2", "--resume")) == 2
    capsys.readouterr()


def test_a_run_and_its_dataset_can_be_moved_together(relative_run, tmp_path):
    os.rename(tmp_path / "a", tmp_path / "moved")
    run = toolkit.load_run(tmp_path / "moved" / "run")
    assert run.dataset_path == tmp_path / "moved" / "mine"
    assert len(run.open_dataset()) == 2


@pytest.mark.parametrize(
    "words",
    [
        ["render", "RUN"],
        ["render", "RUN", "--what", "strip", "labels", "--image-size", "32", "24"],
        ["query", "RUN", "wall", "--mesh", "wall.ply", "--voxel-m", "0.1"],
        ["export", "RUN", "--to", "map.spz"],
        ["export", "RUN", "--to", "map.mesh.ply", "--voxel-m", "0.1"],
    ],
    ids=" ".join,
)
def test_the_dataset_is_not_needed_to_render_query_and_export(
    tiny_run, tmp_path, monkeypatch, words
):
    run = shutil.copytree(tiny_run, tmp_path / "run")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("path: ", "path: /nowhere"))
    monkeypatch.chdir(tmp_path)
    assert main([word.replace("RUN", str(run)) for word in words]) == 0


def test_the_camera_of_the_run_is_that_of_its_dataset(tiny_run, tiny_recording):
    camera = toolkit.open_dataset("folder", tiny_recording).camera
    assert toolkit.load_run(tiny_run).camera == camera
