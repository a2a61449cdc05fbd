"""embed-objects: views of the objects of a run, their embeddings, and the queries that follow."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from labelled_room import IDS, TAXONOMY
from test_finished_run_programs import one_line_of_error
from tiny_models import save_clip

from toolkit.base.errors import ToolkitError
from toolkit.io.object_embeddings import read_objects, unit_rows
from toolkit.runs.maps.labelled import load_labelled_run
from toolkit.runs.maps.object_embedding import (
    EmbeddingOptions,
    ObjectView,
    best_views,
    embed_objects,
    find_views,
)
from toolkit.semantics.options import ObjectOptions
from toolkit.tools.cli.main import main


class CentreColour:
    """Embeds an image by the hue of its centre."""

    name = "centre"

    def embed_images(self, images) -> np.ndarray:
        centres = [image[len(image) // 2, image.shape[1] // 2] for image in images]
        return unit_rows(np.array(centres, float) - np.mean(centres, axis=1, keepdims=True) + 1e-3)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    pytest.importorskip("transformers")
    return save_clip(tmp_path_factory.mktemp("models") / "clip")


@pytest.fixture
def room(labelled_run, tmp_path) -> Path:
    return shutil.copytree(labelled_run, tmp_path / "run")


def shades() -> np.ndarray:
    """Colours of the classes in `labelled_room.gaussians_at`, without their brightness."""
    rgb = np.random.default_rng(0).uniform(0.2, 0.9, (len(TAXONOMY) + 1, 3))
    return unit_rows(rgb - rgb.mean(axis=1, keepdims=True))


def test_every_visible_object_has_the_embedding_of_its_image(room):
    labelled = load_labelled_run(room)
    objects = labelled.map.objects(None, labelled.map.ground(), ObjectOptions())
    dataset = labelled.run.open_dataset()
    found = embed_objects(labelled, objects, dataset, CentreColour(), EmbeddingOptions())
    assert found.model == "centre"
    classes = [TAXONOMY.classes[i - 1] for i in found.class_ids]
    assert classes.count("table") == 1
    assert "floor" in classes
    for number, class_id in zip(found.ids, found.class_ids, strict=True):
        assert objects[number].node.name == TAXONOMY.classes[class_id - 1]
    # The table stands free in the middle of its box; chairs and walls may be partly behind it.
    table = classes.index("table")
    assert found.embeddings[table] @ shades()[IDS["table"]] > 0.95
    np.testing.assert_allclose(
        found.centres_m[table], objects[found.ids[table]].box.centre_m, atol=1e-5
    )


def test_views_lie_in_the_image_and_hidden_objects_have_none(room):
    labelled = load_labelled_run(room)
    objects = labelled.map.objects(None, labelled.map.ground(), ObjectOptions())
    views = find_views(labelled, objects, 10)
    camera = labelled.run.camera
    for view in views:
        left, top, right, bottom = view.box
        assert 0 <= left < right <= camera.width
        assert 0 <= top < bottom <= camera.height
        assert 0 < view.weight <= 1
        assert view.frame in labelled.run.keyframes
    # Everything is turned away if the cameras look back.
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    for frame in labelled.run.tracked:
        frame.T_map_camera[:] = frame.T_map_camera @ turned
    table = next(o for o in objects if o.node.name == "table")
    assert find_views(labelled, [table], 10) == []
    with pytest.raises(ToolkitError, match="no keyframe shows an object"):
        embed_objects(
            labelled, [table], labelled.run.open_dataset(), CentreColour(), EmbeddingOptions()
        )


def test_the_best_view_of_each_part_of_the_path_is_used():
    weights = (0.9, 0.8, 0.1, 0.2, 0.3, 0.4)
    views = [
        ObjectView(number, frame, (0, 0, 9, 9), weight)
        for number in (1, 0)
        for frame, weight in enumerate(weights)
    ]
    best = best_views(views, 2)
    assert [(view.frame, view.number) for view in best] == [(0, 0), (0, 1), (5, 0), (5, 1)]
    assert len(best_views(views, 9)) == len(views)


def test_the_program_writes_what_query_searches(room, clip, capsys):
    words = ["embed-objects", str(room), "--encoder", str(clip), "--device", "cpu"]
    assert main([*words, "--codes", "8"]) == 0
    capsys.readouterr()
    objects = read_objects(room / "objects.npz")
    assert main(["query", str(room), "--summary", str(room / "scene.json")]) == 0
    scene = json.loads((room / "scene.json").read_text())
    names = {item["id"]: item["name"] for item in scene["objects"]}
    for number, class_id in zip(objects.ids, objects.class_ids, strict=True):
        assert names[number] == TAXONOMY.classes[class_id - 1]
    capsys.readouterr()
    search = ["query", str(room), "red mug", "--encoder", str(clip), "--device", "cpu", "--json"]
    assert main(search) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert len(found["ranking"]) == min(5, len(objects))
    assert "objects.npz exists; replace it with --replace" in one_line_of_error(capsys, *words)
    assert main([*words, "--replace"]) == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--encoder", "nowhere"], "nowhere has no config.json"),
        (["--encoder", "CLIP", "--codes", "7"], "--codes 7 does not divide the 24 values"),
        (["--encoder", "CLIP", "--dataset", "nowhere"], "nowhere"),
        (["--encoder", "CLIP", "--max-views", "0"], "--max-views"),
        ([], "--encoder"),
    ],
)
def test_bad_arguments_write_nothing(room, clip, capsys, words, said):
    words = [word.replace("CLIP", str(clip)) for word in words]
    assert said in one_line_of_error(capsys, "embed-objects", room, *words)
    assert not (room / "objects.npz").exists()
