"""What files of a map say beside its Gaussians: class tree, origin, unit of length."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from labelled_room import IDS, TAXONOMY
from test_export_formats import UTM

from toolkit.io.length_names import LengthNames
from toolkit.io.splat_placement import origin_in
from toolkit.io.splats import read_splats
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.main import main
from toolkit.tools.serving.listing import listing_page
from toolkit.tools.serving.requests import QueryParameters
from toolkit.tools.serving.served_run import ServedRun
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.reading import read_scene

ORIGIN = "origin_m 388096.000 3948996.000 57.000"
UNITS = LengthNames(metric=False).notes[0]


@pytest.fixture
def noted_run(labelled_run, tmp_path) -> Path:
    """A run of unknown scale, with an origin in UTM."""
    run = shutil.copytree(labelled_run, tmp_path / "run")
    content = json.loads((run / "frames.json").read_text())
    content |= {"origin_m": UTM.tolist(), "metric": False}
    (run / "frames.json").write_text(json.dumps(content))
    return run


def test_an_edited_map_can_be_viewed_and_converted_with_its_classes(noted_run, tmp_path, capsys):
    out = tmp_path / "edited"
    assert main(["edit", str(noted_run), "--out", str(out), "--remove", "wall", "chair"]) == 0
    lines = capsys.readouterr().out
    assert "square units" in lines
    assert UNITS in lines
    assert json.loads((out / "edit.json").read_text())["metric"] is False
    assert read_splats(out / "map.ply").comments == (ORIGIN, UNITS)
    scene = read_scene(out / "map.ply", ShownContent())
    assert (scene.length, scene.notes) == ("units", (UNITS,))
    assert "table" in {scene.tree.nodes[node].path[-1] for node in scene.splats.levels[:, -1]}
    assert main(["export", str(out / "map.ply"), "--to", str(tmp_path / "map.sog")]) == 0
    assert Taxonomy.from_json(read_splats(tmp_path / "map.sog").taxonomy) == TAXONOMY


def test_conversions_keep_origin_and_unit(noted_run, tmp_path, caplog):
    """A scene contains the origin in its transformation, other files in a comment."""
    before = read_splats(noted_run / "map.ply").means
    source = noted_run
    for name in ("a.splats.glb", "b.ply", "c.splats.glb"):
        assert main(["export", str(source), "--to", str(tmp_path / name)]) == 0
        source = tmp_path / name
        splats = read_splats(source)
        assert splats.comments == (ORIGIN, UNITS)
        np.testing.assert_array_equal(splats.means, before)
    assert "b.ply has single precision" in caplog.text
    content = source.read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    extras = tree["nodes"][0]["extras"]
    assert extras["metric"] is False
    np.testing.assert_allclose(np.array(extras["T_gltf_map"])[:3, 3], UTM * (1, -1, -1))


def test_answers_as_json_say_whether_lengths_are_metres(noted_run, labelled_run, tmp_path, capsys):
    """Programs do not read the note below the table."""
    for run, metric in ((noted_run, False), (labelled_run, True)):
        summary = tmp_path / "scene.json"
        assert main(["query", str(run), "chair", "--json", "--summary", str(summary)]) == 0
        (answer,) = json.loads(capsys.readouterr().out)
        assert answer["metric"] is metric
        assert json.loads(summary.read_text())["metric"] is metric


def test_the_service_says_whether_lengths_are_metres(noted_run):
    served = ServedRun(noted_run, max_pixels=100_000)
    description = served.description()
    assert (description["metric"], description["map_origin_m"]) == (False, UTM.tolist())
    assert served.answer(QueryParameters(name="chair"))["metric"] is False
    page = listing_page(served.name, served.length_names, [])
    assert "an arbitrary unit" in page
    assert "metres" not in page


def test_objects_of_unknown_scale_are_not_registered(noted_run, labelled_run, tmp_path, capsys):
    """The runs have no submaps: the reason is the unit of length."""
    words = ["--out", str(tmp_path / "page.html"), "--objects", str(tmp_path / "changes.json")]
    for path in (noted_run, labelled_run):
        (path / "metrics.json").write_text("{}")
    assert main(["compare", str(labelled_run), str(noted_run), *words]) == 2
    assert "lengths in arbitrary units" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.html"))


def test_a_scene_of_a_converted_file_names_its_classes(labelled_run, tmp_path):
    target = tmp_path / "map.splats.gltf"
    assert main(["export", str(labelled_run / "map.ply"), "--to", str(target)]) == 0
    classes = json.loads(target.read_text())["asset"]["extras"]["classes"]
    assert classes[str(IDS["table"])] == "table"


@pytest.mark.parametrize("line", ["origin_m", "origin_m 1 2", "origin_m 1 2 x", "origin_m 1 nan 2"])
def test_a_comment_without_three_numbers_is_no_origin(line):
    assert not origin_in([line]).any()
