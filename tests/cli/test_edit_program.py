"""edit: what it changes, what it leaves, and the holes that it reports."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from labelled_room import IDS
from test_finished_run_programs import one_line_of_error

from toolkit.io.images import read_rgb
from toolkit.io.splats import read_splats
from toolkit.runs.maps.editing import painted_harmonics
from toolkit.tools.cli.main import main


@pytest.fixture
def edit(labelled_run, tmp_path):
    """Edits the run; returns the splats and the report."""

    def edited(*words: str):
        out = tmp_path / "out"
        assert main(["edit", str(labelled_run), "--out", str(out), "--every", "1", *words]) == 0
        return read_splats(out / "map.ply"), json.loads((out / "edit.json").read_text())

    return edited


def test_removed_classes_leave_their_holes(edit, labelled_run, tmp_path, capsys):
    before = read_splats(labelled_run / "map.ply").labels.label
    splats, report = edit("--remove", "wall")
    assert "holes: " in capsys.readouterr().out
    assert report["removed"] == (before == IDS["wall"]).sum()
    assert len(splats) == (before != IDS["wall"]).sum()
    assert set(splats.labels.label) == {IDS["floor"], IDS["table"], IDS["chair"]}
    # Nothing is behind the walls.
    assert report["hole_percent"] > 5.0
    assert len(list((tmp_path / "out/renders").glob("colour_*.png"))) == 3


def test_what_stood_on_the_floor_leaves_none(edit, tmp_path):
    splats, report = edit("--remove", "chair")
    assert IDS["chair"] not in splats.labels.label
    assert report["hole_percent"] < 0.1
    assert report["floor_hole_m2"] == 0.0


def test_missing_floor_is_reported_as_an_area(edit):
    _, report = edit("--keep", "table", "wall")
    # All of the floor but the cells that walls and the sides of the table touch.
    assert report["floor_hole_m2"] == pytest.approx(12.0, abs=1.0)


def test_moved_classes_move_relative_to_the_first_camera(edit, labelled_run):
    before = read_splats(labelled_run / "map.ply")
    pose = np.loadtxt(labelled_run / "trajectory.txt")[0]
    splats, report = edit("--move", "chair", "0.5", "-0.25", "1")
    chairs = before.labels.label == IDS["chair"]
    offset = splats.means[chairs] - before.means[chairs]
    np.testing.assert_allclose(splats.means[~chairs], before.means[~chairs])
    np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-5)
    assert np.linalg.norm(offset[0]) == pytest.approx(np.linalg.norm([0.5, 0.25, 1]), abs=1e-4)
    # The third axis of the first camera, from its quaternion.
    x, y, z, w = pose[4:]
    forward = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    assert offset[0] @ forward == pytest.approx(1.0, abs=1e-4)
    assert report["moved"] == chairs.sum()


def test_recoloured_classes_take_the_colour(edit, tmp_path):
    splats, report = edit("--recolour", "table", "255", "0", "0", "chair", "0", "0", "255")
    table = splats.colours[splats.labels.label == IDS["table"]]
    np.testing.assert_allclose(table, np.broadcast_to([1.0, 0, 0], table.shape), atol=1e-5)
    assert report["removed"] == 0
    picture = read_rgb(next((tmp_path / "out/renders").glob("colour_*.png")))
    assert ((picture[..., 0] > 0.8) & (picture[..., 1] < 0.2)).mean() > 0.01


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "nothing to edit"),
        (["--remove", "chiar"], "did you mean chair"),
        (["--remove", "sofa"], "contains no 'sofa'"),
        (["--remove", "large items"], "remove all Gaussians"),
        (["--recolour", "chair", "0", "0", "256"], "--recolour"),
        (["--move", "chair", "0"], "--move"),
    ],
)
def test_bad_edits_are_reported_in_one_line(labelled_run, tmp_path, capsys, words, said):
    line = one_line_of_error(capsys, "edit", labelled_run, "--out", tmp_path / "out", *words)
    assert said in line
    assert not (tmp_path / "out").exists()


def test_edit_needs_labels_and_an_empty_folder(run, labelled_run, tmp_path, capsys):
    line = one_line_of_error(capsys, "edit", run, "--out", tmp_path / "out", "--remove", "chair")
    assert "has no labels" in line
    words = ["--out", labelled_run, "--remove", "chair"]
    assert "not an empty folder" in one_line_of_error(capsys, "edit", labelled_run, *words)


def test_recoloured_harmonics_have_the_new_hue():
    """A view from anywhere shows the hue, with the brightness that varied as before."""
    colours = torch.full((1, 3), 0.5)
    harmonics = torch.zeros(1, 3, 3)
    harmonics[0, 1] = torch.tensor([0.3, 0.0, 0.0])
    changed = painted_harmonics(harmonics, colours, (0.0, 0.8, 0.0))
    np.testing.assert_allclose(changed[0, 1], [0.0, 0.16, 0.0], atol=1e-6)
    assert not changed[0, [0, 2]].any()
