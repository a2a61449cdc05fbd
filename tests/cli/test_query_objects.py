"""query with embeddings: texts, images and vectors rank the objects of a run."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labelled_room import IDS
from test_finished_run_programs import one_line_of_error
from tiny_models import save_clip, save_siglip

from toolkit.io.images import write_png
from toolkit.io.object_embeddings import ObjectEmbeddings, read_objects, unit_rows, write_objects
from toolkit.semantics.features.pretrained.text_image import TextImageEncoder
from toolkit.tools.cli.main import main

pytest.importorskip("transformers")

TEXTS = ("red mug", "blue sofa", "a chair", "photo of a mug")


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    return save_clip(tmp_path_factory.mktemp("models") / "clip")


@pytest.fixture(scope="module")
def room(labelled_run, clip, tmp_path_factory) -> Path:
    """A labelled run with four objects whose embeddings are near those of four texts."""
    folder = shutil.copytree(labelled_run, tmp_path_factory.mktemp("room") / "run")
    encoder = TextImageEncoder(clip, "cpu")
    noise = np.random.default_rng(0).normal(0, 0.02, (len(TEXTS), encoder.dimensions))
    objects = ObjectEmbeddings(
        np.array([11, 12, 13, 14], np.int32),
        np.array([IDS["cup"], 0, IDS["chair"], IDS["cup"]], np.int32),
        unit_rows(encoder.embed_texts(TEXTS) + noise),
        np.ones(len(TEXTS), np.float32),
        encoder.name,
        np.arange(12, dtype=np.float32).reshape(4, 3),
    )
    write_objects(folder / "objects.npz", objects)
    return folder


def ranked(capsys, *words: object) -> list:
    assert main(["query", *map(str, words), "--json", "--device", "cpu"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_text_ranks_the_objects(room, clip, capsys):
    (red, blue) = ranked(capsys, room, "red mug", "blue sofa", "--encoder", clip, "--top", "2")
    assert red["ranking"][0]["id"] == 11
    assert red["ranking"][0]["path"] == ["small items", "cup"]
    assert red["ranking"][0]["similarity"] > 0.95
    assert red["ranking"][0]["centre_m"] == [0, 1, 2]
    assert len(red["ranking"]) == 2
    assert blue["ranking"][0] | {"similarity": 0, "weight": 0} == {
        "id": 12,
        "instance": None,
        "name": None,
        "path": [],
        "similarity": 0,
        "weight": 0,
        "centre_m": [3, 4, 5],
    }
    words = ["query", str(room), "red mug", "--encoder", str(clip), "--device", "cpu"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("red mug: the 4 most similar of 4 objects (clip ")
    assert lines[1].split() == ["object", "class", "similarity", "position", "(m)"]
    assert lines[2].split()[:3] == ["1", "11", "cup"]
    assert lines[2].endswith("0.00 1.00 2.00")


def test_exact_names_are_answered_first(room, clip, capsys):
    answer, ranking = ranked(capsys, room, "chair", "--encoder", clip)
    assert len(answer["objects"]) == 2
    assert ranking["query"] == "chair"
    assert main(["query", str(room), "chair", "--encoder", str(clip), "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert 0 < printed.index("2 object(s)") < printed.index("most similar")


def test_classes_whose_gaussians_form_no_object_say_how_to_find_some(room, capsys):
    assert main(["query", str(room), "chair", "--min-gaussians", "100000"]) == 0
    printed = capsys.readouterr().out
    assert "0 object(s)" in printed and "try a smaller --min-gaussians" in printed


def test_vectors_and_images_rank_the_objects(room, clip, tmp_path, capsys):
    np.save(tmp_path / "second.npy", read_objects(room / "objects.npz").embeddings[1:2])
    (found,) = ranked(capsys, room, "--embedding", tmp_path / "second.npy")
    assert found["query"] == "second.npy"
    assert found["ranking"][0]["id"] == 12
    image = np.full((40, 50, 3), (200, 20, 20), np.uint8)
    write_png(tmp_path / "mug.png", image)
    encoder = TextImageEncoder(clip, "cpu")
    expected = read_objects(room / "objects.npz").embeddings @ encoder.embed_images([image])[0]
    (found,) = ranked(capsys, room, "--image", tmp_path / "mug.png", "--encoder", clip)
    best = found["ranking"][0]
    assert best["id"] == 11 + int(np.argmax(expected))
    assert best["similarity"] == pytest.approx(expected.max(), abs=1e-3)


def test_other_models_and_vectors_are_refused(room, clip, tmp_path, capsys):
    siglip, other = save_siglip(tmp_path / "siglip"), save_clip(tmp_path / "other", seed=1)
    capsys.readouterr()  # saving prints progress
    for model in (siglip, other):
        line = one_line_of_error(capsys, "query", room, "mug", "--encoder", model)
        assert "use the model of the objects" in line
    np.save(tmp_path / "short.npy", np.ones(5))
    line = one_line_of_error(capsys, "query", room, "--embedding", tmp_path / "short.npy")
    assert "has shape [5], the embeddings of the objects have 24 values" in line


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--image", "a.png"], "--image needs --encoder"),
        (["mug", "--embedding", "a.npy"], "texts are compared with embeddings by --encoder"),
        (["--encoder", "CLIP"], "give a text or --image"),
        (["mug", "--encoder", "FOLDER"], "has no config.json"),
        (["mug", "--encoder", "CLIP", "--cloud", "a.ply"], "are for queries by class"),
        (["x" * 10_000, "--encoder", "CLIP"], "has 10000 characters; give at most 200"),
        (["--embedding", "FOLDER/none.npy"], "is not a readable .npy file"),
        (["--embedding", "FOLDER/text.npy"], "is not a readable .npy file"),
        (["--embedding", "FOLDER/square.npy"], "must contain one vector"),
        (["--image", "FOLDER/none.png", "--encoder", "CLIP"], "none.png"),
        (["mug", "--encoder", "CLIP", "--top", "0"], "--top"),
    ],
)
def test_bad_searches_are_reported_in_one_line(room, clip, tmp_path, capsys, words, said):
    (tmp_path / "text.npy").write_text("no array")
    np.save(tmp_path / "square.npy", np.ones((2, 2)))
    names = {"FOLDER": str(tmp_path), "CLIP": str(clip)}
    for name, path in names.items():
        words = [word.replace(name, path) for word in words]
    assert said in one_line_of_error(capsys, "query", room, *words)


def test_runs_without_objects_or_with_those_of_another_tree_are_refused(
    room, labelled_run, clip, tmp_path, capsys
):
    line = one_line_of_error(capsys, "query", labelled_run, "mug", "--encoder", clip)
    assert "objects.npz does not exist: the run has no embeddings of objects" in line
    other = shutil.copytree(room, tmp_path / "other")
    objects = read_objects(other / "objects.npz")
    write_objects(other / "objects.npz", replace(objects, class_ids=np.full(4, 99, np.int32)))
    line = one_line_of_error(capsys, "query", other, "mug", "--encoder", clip)
    assert "contains class 99, taxonomy 'room' has 6 classes" in line
