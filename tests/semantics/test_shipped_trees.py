"""The trees that come with the package, as files, text and pictures."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET

import cv2
import pytest

from toolkit.base.errors import FormatError
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_drawing import draw_taxonomy
from toolkit.semantics.taxonomy_text import tree_text
from toolkit.semantics.trees import (
    shipped_names,
    shipped_taxonomy,
    taxonomy_for,
    taxonomy_named,
)

SIZES = {"geometric": 5, "indoor": 23, "nyu40": 40, "replica": 101, "scannet20": 20}


def test_all_trees_are_there():
    assert {name: len(shipped_taxonomy(name)) for name in shipped_names()} == SIZES


def test_ids_are_the_data_sets_own():
    assert shipped_taxonomy("replica").classes == CLASS_NAMES
    assert shipped_taxonomy("nyu40").classes[:5] == ("wall", "floor", "cabinet", "bed", "chair")
    assert shipped_taxonomy("geometric").classes == (
        *("floor", "wall", "ceiling", "surface", "object"),
    )


def test_a_real_recording_s_ids_are_the_tree_s(real_data):
    path = real_data("replica_office0") / "labels" / "classes.json"
    names = {int(k): v for k, v in json.loads(path.read_text())["classes"].items()}
    table = shipped_taxonomy("replica").relabelling(names)
    assert table.tolist() == list(range(102))


def test_an_unknown_name_is_answered_with_those_there_are():
    with pytest.raises(FormatError, match="choose geometric, indoor, nyu40, replica, scannet20"):
        shipped_taxonomy("kitti")
    with pytest.raises(FormatError, match="choose geometric"):
        taxonomy_named("../replica")


def test_a_name_or_a_file_gives_a_tree(tmp_path):
    path = tmp_path / "mine.yaml"
    shipped_taxonomy("nyu40").save(path)
    assert taxonomy_named(path) == taxonomy_named("nyu40")
    with pytest.raises(FormatError, match="cannot be read"):
        taxonomy_named(tmp_path / "absent.yaml")


@pytest.mark.parametrize(
    ("classes", "name"),
    [
        (["floor", "wall"], "geometric"),
        (["void", "Wall", "shower_curtain"], "scannet20"),
        (["wall", "whiteboard"], "nyu40"),
        (["tv stand", "base cabinet"], "replica"),
        (["wall", "blinds", "thing"], "indoor"),
        (["wall", "dragon"], None),
        ([], None),
    ],
)
def test_the_smallest_tree_that_has_all_classes_is_found(classes, name):
    found = taxonomy_for(classes)
    assert (found.name if found else None) == name


@pytest.fixture
def small() -> Taxonomy:
    return Taxonomy({"large": {"seats": ["sofa", "chair"], "bed": None}, "cup": {}}, name="few")


def test_text_shows_levels_and_counts(small):
    assert tree_text(small).splitlines() == [
        "few: 4 classes, 3 levels (level 0: 2, level 1: 2, level 2: 2)",
        "  large  (level 0, 3 classes)",
        "    seats  (level 1, 2 classes)",
        "      sofa",
        "      chair",
        "    bed",
        "  cup",
    ]


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_pictures_are_the_same_each_time(small, tmp_path, suffix):
    paths = [tmp_path / f"{n}{suffix}" for n in "ab"]
    for path in paths:
        draw_taxonomy(small, path)
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_picture_names_every_node(tmp_path):
    taxonomy = shipped_taxonomy("nyu40")
    path = tmp_path / "tree.svg"
    draw_taxonomy(taxonomy, path)
    comments = path.read_text("utf-8")  # the letters are outlines, their text a comment
    assert ET.parse(path).getroot().tag.endswith("svg")
    for node in taxonomy.nodes:
        assert node.name.split()[0] in comments


def test_long_trees_are_about_as_wide_as_a_page(tmp_path):
    path = tmp_path / "tree.png"
    draw_taxonomy(shipped_taxonomy("replica"), path, dpi=40)
    height, width = cv2.imread(str(path)).shape[:2]
    assert 0.7 < width / height < 3


def test_other_files_cannot_be_drawn(small, tmp_path):
    with pytest.raises(FormatError, match=r"can be drawn as \.png, \.svg, \.pdf"):
        draw_taxonomy(small, tmp_path / "tree.bmp")
