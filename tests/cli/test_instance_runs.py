"""Runs with instances, from masks to the objects of the map."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_semantic_runs import QUICK, error_of
from tiny_mask_models import CLASSES, save_mask2former

from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.synthetic_rooms import RoomSettings, make_room
from toolkit.io.images import read_labels, write_png
from toolkit.io.splats import read_splats
from toolkit.runs.execution import run as execute
from toolkit.runs.settings import CheckpointOptions, load_settings
from toolkit.scene.instances.options import InstanceOptions
from toolkit.slam.mapping.options import MapperOptions
from toolkit.tools.cli.main import main

FRAMES = 8


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """A short way through a room, with true instances."""
    folder = tmp_path_factory.mktemp("instances") / "room"
    make_room(folder, RoomSettings(frames=FRAMES, share=0.05, width=96, height=72, unseen=1))
    return folder


@pytest.fixture(scope="session")
def masks(room, tmp_path_factory) -> Path:
    """The true instances, numbered anew in every frame."""
    folder = tmp_path_factory.mktemp("masks")
    rng = np.random.default_rng(0)
    for index in range(FRAMES):
        ids = read_labels(room / "instances" / f"instance{index:06d}.png")
        found = np.unique(ids)
        table = np.zeros(found.max() + 1, np.uint16)
        table[found[found > 0]] = rng.permutation((found > 0).sum()) + 1
        write_png(folder / f"{index:06d}.png", table[ids])
    return folder


def arguments(room: Path, out: Path, *more: object) -> list[str]:
    place = ["--dataset.kind", "synthetic", "--dataset.path", str(room), "--poses", "given"]
    return ["run", *place, *QUICK, "--out", str(out), *map(str, more)]


@pytest.fixture(scope="session")
def run(room, masks, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    options = ["--instances.kind", "folder", "--instances.path", masks]
    assert main(arguments(room, out, *options)) == 0
    return out


def test_a_room_writes_objects_of_one_class_each(room):
    classes: dict[int, set[int]] = {}
    for index in range(FRAMES):
        ids = read_labels(room / "instances" / f"instance{index:06d}.png")
        labels = read_labels(room / "labels" / f"label{index:06d}.png")
        assert ids[labels > 0].all()
        for number in np.unique(ids[ids > 0]):
            classes.setdefault(int(number), set()).update(labels[ids == number].tolist())
    assert len(classes) > 5
    assert all(len(found) == 1 for found in classes.values())
    assert (room / "unseen" / "instances" / "instance000000.png").is_file()


def test_every_gaussian_knows_its_object(run):
    ids = read_splats(run / "map.ply").extra["instance"]
    objects = json.loads((run / "objects.json").read_text())["objects"]
    assert [one["id"] for one in objects] == list(range(1, len(objects) + 1))
    counts = np.bincount(ids, minlength=len(objects) + 1)
    assert counts[1:].tolist() == [one["gaussians"] for one in objects]
    assert counts[0] < 0.1 * len(ids)
    names = [one["class"] for one in objects]
    assert {"wall", "floor"} <= set(names)
    wall = objects[names.index("wall")]
    assert wall["path"][-1] == "wall"
    assert (wall["first_keyframe"], wall["views"] > 1) == (0, True)


def test_the_objects_of_a_class_agree_with_its_labels(run):
    splats = read_splats(run / "map.ply")
    labels = splats.labels
    assert labels is not None
    assert labels.instances is not None
    for number in range(1, int(labels.instances.max()) + 1):
        own = labels.label[labels.instances == number]
        assert np.bincount(own).max() > 0.6 * len(own)


def test_query_counts_objects_by_instance(run, capsys):
    assert main(["query", str(run), "wall", "--json", "--min-gaussians", "1"]) == 0
    (answer,) = json.loads(capsys.readouterr().out)
    objects = json.loads((run / "objects.json").read_text())["objects"]
    walls = [one["id"] for one in objects if one["class"] == "wall"]
    assert {one["instance"] for one in answer["objects"]} >= set(walls)


def test_render_draws_objects(run, tmp_path):
    line = ["render", str(run), "--what", "instances", "--every", "8", "--out", str(tmp_path)]
    assert main(line) == 0
    assert (tmp_path / "instances_000000.png").is_file()


def test_edited_maps_keep_the_objects_of_their_gaussians(run, tmp_path):
    out = tmp_path / "edited"
    assert main(["edit", str(run), "--remove", "wall", "--out", str(out)]) == 0
    splats, original = read_splats(out / "map.ply"), read_splats(run / "map.ply")
    assert original.labels is not None
    kept = np.isin(original.means.view("V12").reshape(-1), splats.means.view("V12").reshape(-1))
    np.testing.assert_array_equal(splats.extra["instance"], original.extra["instance"][kept])


def test_exported_maps_have_their_objects_beside_them(run, tmp_path):
    out = tmp_path / "map.spz"
    assert main(["export", str(run), "--to", str(out)]) == 0
    with np.load(tmp_path / "map.spz.labels.npz") as arrays:
        found = np.sort(arrays["instances"])
    expected = np.sort(read_splats(run / "map.ply").extra["instance"])
    assert np.bincount(found)[1:].sum() > 0.9 * np.bincount(expected)[1:].sum()


def direction(number: int) -> np.ndarray:
    """The embedding of a true object."""
    return np.random.default_rng([3, number]).normal(size=16)


@pytest.fixture(scope="session")
def embedded_masks(room, masks, tmp_path_factory) -> Path:
    """The masks, with the embeddings of their true objects."""
    folder = shutil.copytree(masks, tmp_path_factory.mktemp("embedded") / "masks")
    for index in range(FRAMES):
        true = read_labels(room / "instances" / f"instance{index:06d}.png")
        shown = read_labels(folder / f"{index:06d}.png")
        ids = np.unique(shown[shown > 0])
        numbers = [int(true[shown == i][0]) for i in ids]
        columns = {"embeddings": np.stack([direction(n) for n in numbers]), "model": "by number"}
        np.savez(folder / f"{index:06d}.npz", ids=ids, **columns)
    return folder


def largest(room: Path) -> int:
    """The true object that most pixels of the first frame show."""
    ids = read_labels(room / "instances" / "instance000000.png")
    return int(np.bincount(ids.reshape(-1)).argmax())


def found_by(capsys, run: Path, vector: np.ndarray) -> list[dict]:
    np.save(run / "query.npy", vector)
    assert main(["query", str(run), "--embedding", str(run / "query.npy"), "--json"]) == 0
    (answer,) = json.loads(capsys.readouterr().out)
    assert answer["model"] == "by number"
    return answer["ranking"]


def test_query_finds_objects_by_the_embeddings_of_their_masks(
    room, embedded_masks, tmp_path, capsys
):
    out = tmp_path / "run"
    folder = ["--instances.kind", "folder", "--instances.path", embedded_masks]
    assert main(arguments(room, out, *folder)) == 0
    capsys.readouterr()
    best, second, *_ = found_by(capsys, out, direction(largest(room)))
    assert best["similarity"] > 0.99 > second["similarity"]
    assert main(["query", str(out), "--summary", str(out / "scene.json")]) == 0
    listed = {one["id"]: one for one in json.loads((out / "scene.json").read_text())["objects"]}
    for row in (best, second):
        assert listed[row["id"]]["name"] == row["name"]
        assert listed[row["id"]]["instance"] == row["instance"]
    objects = json.loads((out / "objects.json").read_text())["objects"]
    assert objects[best["instance"] - 1]["class"] == best["name"]


def test_objects_of_a_map_without_labels_have_embeddings_too(
    room, embedded_masks, tmp_path, capsys
):
    out = tmp_path / "run"
    options = ["--instances.kind", "folder", "--instances.path", embedded_masks]
    assert main(arguments(room, out, *options, "--segmenter.kind", "none")) == 0
    capsys.readouterr()
    best = found_by(capsys, out, direction(largest(room)))[0]
    ids = [one["id"] for one in json.loads((out / "objects.json").read_text())["objects"]]
    assert best["id"] == best["instance"]
    assert best["id"] in ids
    assert best["similarity"] > 0.99


def test_a_model_yields_the_masks_of_a_run(room, tmp_path, capsys):
    pytest.importorskip("transformers")
    model, out = save_mask2former(tmp_path / "model"), tmp_path / "run"
    options = ["--instances.kind", "model", "--instances.model.folder", model]
    words = arguments(room, out, *options, "--instances.model.min-score", "0")
    assert main(words) == 0
    objects = json.loads((out / "objects.json").read_text())["objects"]
    assert objects
    assert {one["class"] for one in objects} <= set(CLASSES.values())
    capsys.readouterr()
    (model / "preprocessor_config.json").unlink()
    second = tmp_path / "second"
    assert "has no preprocessor_config.json" in error_of(
        capsys, *[second if word == str(out) else word for word in words]
    )
    assert not second.exists()


def test_an_interrupted_run_resumes_to_the_same_objects(room, tmp_path):
    settings = replace(
        load_settings(),
        dataset=DatasetOptions(kind="synthetic", path=room),
        poses="given",
        instances=InstanceOptions("geometric"),
        checkpoint=CheckpointOptions(every_keyframes=1),
        mapping=MapperOptions(first_iterations=6, iterations=3, final_iterations=2),
    )

    def interrupted(items, _total, _start, _unit="frame"):
        for count, item in enumerate(items):
            if count == FRAMES // 2:
                raise RuntimeError("interrupted")
            yield item

    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    execute(settings, whole)
    with pytest.raises(RuntimeError, match="interrupted"):
        execute(settings, resumed, progress=interrupted)
    assert not (resumed / "map.ply").exists()
    execute(settings, resumed, resume=True)
    objects = [json.loads((path / "objects.json").read_text()) for path in (whole, resumed)]
    assert objects[0] == objects[1]
    assert len(objects[0]["objects"]) > 3
    ids = [read_splats(path / "map.ply").extra["instance"] for path in (whole, resumed)]
    np.testing.assert_array_equal(*ids)


def test_a_map_without_instances_has_neither_objects_nor_a_picture_of_them(room, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(arguments(room, out)) == 0
    assert "instance" not in read_splats(out / "map.ply").extra
    assert not (out / "objects.json").exists()
    assert "has no objects" in error_of(capsys, "render", out, "--what", "instances")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("000000.png", b"\x89PNG\r\n\x1a\n", "000000.png"),
        ("000000.npz", b"broken", "000000.npz cannot be read"),
        (None, None, "--instances.path"),
    ],
)
def test_bad_masks_end_the_run_with_one_line(room, masks, tmp_path, capsys, name, content, message):
    out = tmp_path / "run"
    options: list[object] = ["--instances.kind", "folder"]
    if name is not None:
        folder = tmp_path / "masks"
        folder.mkdir()
        (folder / "000000.png").write_bytes((masks / "000000.png").read_bytes())
        (folder / name).write_bytes(content)
        options += ["--instances.path", folder]
    assert message in error_of(capsys, *arguments(room, out, *options))
    assert not out.exists() or not list(out.iterdir())
