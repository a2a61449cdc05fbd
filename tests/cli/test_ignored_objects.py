"""Runs that ignore the masks of an object by a text."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from test_instance_runs import arguments
from test_semantic_runs import error_of
from tiny_models import save_clip

from toolkit.datasets.synthetic_rooms import RoomSettings, make_room
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS
from toolkit.io.images import read_labels, write_png
from toolkit.io.splats import read_splats
from toolkit.runs.evaluation.metrics import read_metrics
from toolkit.runs.maps.finished import load_run
from toolkit.runs.scoring import evaluate
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.main import main

FRAMES = 8
# The object that is ignored: the only one of a class, which its masks call a robot.
TARGET, IGNORED = "wardrobe", 1000
TEXT = "a red object"


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ignored") / "room"
    settings = RoomSettings(frames=FRAMES, share=0.05, width=96, height=72, unseen=1)
    make_room(folder, settings)
    return folder


@pytest.fixture(scope="module")
def shown(room) -> list[np.ndarray]:
    """The masks [H, W] of each frame."""
    found = []
    for index in range(FRAMES):
        ids = read_labels(room / "instances" / f"instance{index:06d}.png")
        labels = read_labels(room / "labels" / f"label{index:06d}.png")
        found.append(np.where(labels == CLASS_IDS[TARGET], IGNORED, ids).astype(np.uint16))
    return found


def write_masks(folder: Path, shown: list[np.ndarray], **columns) -> Path:
    """Masks with columns of the ids, which are functions of the id."""
    folder.mkdir()
    for index, ids in enumerate(shown):
        write_png(folder / f"{index:06d}.png", ids)
        listed = np.unique(ids[ids > 0])
        rows = {name: np.array([of(int(i)) for i in listed]) for name, of in columns.items()}
        np.savez(folder / f"{index:06d}.npz", ids=listed, **rows)
    return folder


def robot(number: int) -> str:
    return "robot" if number == IGNORED else ""


@pytest.fixture(scope="module")
def masks(shown, tmp_path_factory) -> Path:
    return write_masks(tmp_path_factory.mktemp("masks") / "named", shown, classes=robot)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    pytest.importorskip("transformers")
    return save_clip(tmp_path_factory.mktemp("models") / "clip")


@pytest.fixture(scope="module")
def embedded(shown, clip, tmp_path_factory) -> Path:
    """Masks without classes, of which the embedding of the robot is that of a text."""
    from toolkit.semantics.features.pretrained.text_image import TextImageEncoder

    encoder = TextImageEncoder(clip, "cpu")
    ignored, other = encoder.embed_texts([TEXT, "chair"])
    folder = tmp_path_factory.mktemp("masks") / "embedded"
    write_masks(folder, shown, embeddings=lambda i: ignored if i == IGNORED else other)
    for file in folder.glob("*.npz"):
        with np.load(file) as columns:
            np.savez(file, **columns, model=encoder.name)
    return folder


def run(room: Path, out: Path, masks: Path, *more: object) -> list[str]:
    given = ("--instances.kind", "folder", "--instances.path", masks)
    return arguments(room, out, *given, "--semantics.ignore", *more)


def classes(out: Path) -> set[str]:
    return {one["class"] for one in json.loads((out / "objects.json").read_text())["objects"]}


def mapped(out: Path) -> set[str]:
    """Classes of the Gaussians."""
    taxonomy, labels = Taxonomy.load(out / "taxonomy.yaml"), read_splats(out / "map.ply").labels
    return {taxonomy.nodes[i].name for i in np.unique(labels.levels) if i >= 0}


def test_masks_that_are_not_ignored_are_objects_of_the_map(room, masks, tmp_path):
    out = tmp_path / "run"
    named = ("--instances.kind", "folder", "--instances.path", masks)
    assert main(arguments(room, out, *named)) == 0
    assert "robot" in classes(out) and TARGET in mapped(out)


def test_masks_of_an_ignored_class_are_neither_mapped_nor_objects(room, masks, tmp_path):
    out = tmp_path / "run"
    assert main(run(room, out, masks, "robots")) == 0
    assert "robot" not in classes(out) and len(classes(out)) > 3
    assert TARGET not in mapped(out)


def test_masks_are_ignored_without_labels_too(room, masks, tmp_path):
    out = tmp_path / "run"
    assert main(run(room, out, masks, "robot", "--segmenter.kind", "none")) == 0
    objects = json.loads((out / "objects.json").read_text())["objects"]
    assert len(objects) > 3 and "robot" not in {one["class"] for one in objects}
    metrics = read_metrics(out / "metrics.json")
    again = evaluate(load_run(out))
    assert again["images"]["mapped"]["psnr_db"] == pytest.approx(
        metrics["images"]["mapped"]["psnr_db"], abs=0.01
    )
    assert metrics["images"]["mapped"]["psnr_db"] > 30.0


def test_masks_are_ignored_by_any_text_with_their_encoder(room, embedded, clip, tmp_path):
    out = tmp_path / "run"
    encoder = ("--instances.encoder", clip, "--instances.model.device", "cpu")
    assert main(run(room, out, embedded, TEXT, *encoder)) == 0
    assert len(classes(out)) > 3
    assert TARGET not in classes(out) | mapped(out)


def test_errors_are_one_line(room, masks, embedded, clip, tmp_path, capsys):
    other = save_clip(tmp_path / "other", seed=1, dimensions=16)
    plain = shutil.copytree(masks, tmp_path / "plain")
    for file in plain.glob("*.npz"):
        file.unlink()
    encoder = ("--instances.encoder", clip)
    cases = [
        (run(room, tmp_path / "a", plain, "robot"), "means 'robot'.*--instances.encoder"),
        (run(room, tmp_path / "b", masks, "unicorns"), "unicorns.*no class of the masks means it"),
        (run(room, tmp_path / "c", embedded, TEXT, "--instances.encoder", other),
         "length 24, those of --instances.encoder have 16"),
        (arguments(room, tmp_path / "d", "--instances.kind", "folder", "--instances.path", masks,
                   *encoder), "no effect without texts"),
        (arguments(room, tmp_path / "e", "--semantics.ignore", "table", *encoder),
         "needs masks with embeddings"),
    ]  # fmt: skip
    for words, message in cases:
        assert re.search(message, error_of(capsys, *words))
