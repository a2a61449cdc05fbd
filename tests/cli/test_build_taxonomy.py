"""build-taxonomy with the built-in rules: as users call it, and what it says to bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from programs import semsplat

from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.main import main

NAMES = [
    "bed",
    "chair",
    "desk",
    "sofa",
    "lamp",
    "book",
    "plate",
    "cup",
    "fridge",
    "oven",
    "shelf",
    "rug",
    "curtain",
    "door",
]


@pytest.fixture
def names_file(tmp_path) -> Path:
    file = tmp_path / "names.txt"
    file.write_text("# my flat\n" + "\n".join(NAMES) + "\n\n")
    return file


def build(*words: object) -> int:
    return main(["build-taxonomy", *map(str, words)])


def test_the_program_writes_a_tree_of_a_list_and_shows_it(names_file, tmp_path):
    out = tmp_path / "flat.yaml"
    words = ["--classes", names_file, "--out", out, "--picture", tmp_path / "flat.png", "--review"]
    done = semsplat("build-taxonomy", *words)
    assert done.returncode == 0, done.stderr
    taxonomy = Taxonomy.load(out)
    assert taxonomy.classes == tuple(NAMES)
    assert taxonomy.name == "flat"
    assert f"{taxonomy}; " in done.stdout
    assert "channels one-hot" in done.stdout
    shown = [line.strip() for line in done.stdout.splitlines()]
    assert set(NAMES) <= set(shown)
    assert (tmp_path / "flat.png").read_bytes().startswith(b"\x89PNG")
    assert done.stderr == ""


def test_a_data_set_gives_its_classes_by_id(tmp_path, capsys):
    ids = {"7": "lamp", "3": "bed", "40": "cup", "12": "rug"}
    file = tmp_path / "classes.json"
    file.write_text(json.dumps({"void": 0, "classes": ids}))
    assert build("--classes", file, "--out", tmp_path / "tree.json") == 0
    assert Taxonomy.load(tmp_path / "tree.json").classes == ("bed", "lamp", "rug", "cup")
    capsys.readouterr()


def test_shapes_are_taken_from_a_table_and_from_meshes(names_file, tmp_path, capsys):
    generator = np.random.default_rng(0)
    rows = [f"{name},{generator.random()},{generator.random()}" for name in NAMES]
    (tmp_path / "table.csv").write_text("\n".join(rows))
    words = ("--classes", names_file, "--out")
    assert build(*words, tmp_path / "a.yaml", "--shapes", "table", tmp_path / "table.csv") == 0
    assert build(*words, tmp_path / "b.yaml", "--shapes", "table", tmp_path / "table.csv") == 0
    assert Taxonomy.load(tmp_path / "a.yaml") == Taxonomy.load(tmp_path / "b.yaml")
    assert Taxonomy.load(tmp_path / "a.yaml").classes == tuple(NAMES)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "chair.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 1\n3 0 1 2\n")
    assert build(*words, tmp_path / "c.yaml", "--shapes", "meshes", tmp_path / "meshes") == 0
    capsys.readouterr()


def test_shapes_of_a_labelled_recording(real_data, tmp_path, capsys):
    room = real_data("replica_office0")
    words = ("--dataset.kind", "replica", "--dataset.path", room, "--out")
    assert build(*words, tmp_path / "names.yaml") == 0
    assert build(*words, tmp_path / "scans.yaml", "--shapes", "scans") == 0
    by_name, by_shape = (Taxonomy.load(tmp_path / f"{n}.yaml") for n in ("names", "scans"))
    assert by_name.classes == by_shape.classes
    assert len(by_name) == 101
    assert by_name != by_shape
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "give --out FILE.yaml to write the taxonomy, or --review"),
        (("--review",), "give either --classes FILE or --dataset.path FOLDER"),
        (("--review", "--classes", "no.txt"), "cannot read no.txt: No such file"),
        (("--review", "--classes", "no.json"), "cannot read no.json"),
        (("--review", "--dataset.path", "none"), "none"),
        (("--review", "--classes", "{names}", "--dataset.path", "x"), "give either --classes"),
        (("--classes", "{names}", "--out", "tree.txt"), "--out tree.txt: the name must end in"),
        (("--classes", "{names}", "--out", "none/tree.yaml"), "there is no folder none"),
        (("--classes", "{names}", "--picture", "tree.bmp"), "--picture tree.bmp: the name must"),
        (
            ("--classes", "{names}", "--review", "--seed", "-1"),
            "--seed: input should be greater than or equal to 0",
        ),
        (("--classes", "{names}", "--review", "--shapes", "scans"), "give --dataset.path"),
        (("--classes", "{names}", "--review", "--shapes", "table"), "--shapes"),
        (("--classes", "{names}", "--review", "--shapes", "table", "no.csv"), "no.csv"),
        (("--classes", "{names}", "--review", "--shapes", "meshes", "none"), "none: no mesh"),
        (("--classes", "{names}", "--review", "--model", "m"), "--model requires --grouper"),
        (("--classes", "{names}", "--review", "--fall-back"), "--fall-back requires --grouper"),
    ],
)
def test_bad_options_end_in_one_line(names_file, capsys, words, message):
    assert build(*(str(word).format(names=names_file) for word in words)) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert printed.out == ""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "two classes or more"),
        (b"bed\n", "two classes or more"),
        (b"bed\nchair\nBed\n", "bed"),
        (b"bed\nchair\nvoid\n", "void"),
        (b"bed\na > b\nchair\n", "'>'"),
        (b"bed\nb\x07ell\nchair\n", "b\\x07ell"),
        (b"bed\n\xff\xfe\nchair", "not UTF-8 text"),
        (b"\x00" * 9, "names.txt: "),
    ],
)
def test_bad_names_end_in_one_line(names_file, capsys, content, message):
    names_file.write_bytes(content)
    assert build("--classes", names_file, "--review") == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.strip().splitlines()) == 1


def test_a_data_set_without_labels_is_an_error(recording, capsys):
    assert build("--dataset.kind", "synthetic", "--dataset.path", recording, "--review") == 2
    assert "has no labels/classes.json; give --classes FILE" in capsys.readouterr().err
