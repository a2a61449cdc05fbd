"""The semantic tree: ids, paths, padding, files, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.semantics.taxonomy import Taxonomy

TREE = {
    "large items": {
        "furnishings": {"soft": ["bed", "sofa"], "hard": ["table"]},
        "building": ["wall"],
    },
    "small items": ["cup", "plate", "vase"],
}


@pytest.fixture
def taxonomy() -> Taxonomy:
    return Taxonomy(TREE, name="rooms")


def test_classes_count_from_one_in_the_tree_s_order(taxonomy):
    assert taxonomy.classes == ("bed", "sofa", "table", "wall", "cup", "plate", "vase")
    assert taxonomy.path(2) == ("large items", "furnishings", "soft", "sofa")


def test_given_classes_decide_the_ids():
    classes = ["wall", "vase", "cup", "plate", "table", "sofa", "bed"]
    taxonomy = Taxonomy(TREE, classes=classes)
    assert list(taxonomy.classes) == classes
    assert taxonomy.path(1) == ("large items", "building", "wall")


def test_level_width_is_the_largest_number_of_siblings(taxonomy):
    assert taxonomy.level_widths == (2, 3, 2, 2)


def test_early_leaves_are_padded_as_only_children(taxonomy):
    cup = taxonomy.classes.index("cup")
    assert taxonomy.local_ids[cup].tolist() == [1, 0, 0, 0]
    assert taxonomy.ancestor(cup + 1, 3).name == "cup"
    assert taxonomy.leaf(cup + 1).level == 1


def test_no_two_classes_share_a_path_of_local_ids(taxonomy):
    assert len(np.unique(taxonomy.local_ids, axis=0)) == len(taxonomy)


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ("bed", "sofa", "soft"),
        ("bed", "table", "furnishings"),
        ("bed", "wall", "large items"),
        ("bed", "cup", None),
        ("cup", "plate", "small items"),
        ("cup", "cup", "cup"),
    ],
)
def test_lowest_common_ancestor(taxonomy, first, second, expected):
    ids = [taxonomy.classes.index(name) + 1 for name in (first, second)]
    node = taxonomy.common_ancestor(*ids)
    assert (node and node.name) == expected


def test_nodes_know_the_classes_below_them(taxonomy):
    assert taxonomy.find("furnishings").class_ids == (1, 2, 3)
    assert taxonomy.find("Large Items > furnishings").class_ids == (1, 2, 3)


def test_level_ids_of_an_image_keep_void_apart(taxonomy):
    image = np.array([[0, 1], [2, 5]])
    ids = taxonomy.level_ids(image, 0)
    assert ids[0, 0] == -1
    assert [taxonomy.nodes[i].name for i in ids.ravel()[1:]] == ["large items"] * 2 + [
        "small items"
    ]


def test_an_unknown_name_gets_a_suggestion(taxonomy):
    with pytest.raises(FormatError, match="did you mean sofa"):
        taxonomy.find("soffa")


def test_an_ambiguous_name_asks_for_a_path():
    taxonomy = Taxonomy({"a": {"flat": ["x"], "tall": ["y"]}, "b": {"flat": ["z", "w"]}})
    with pytest.raises(FormatError, match="longer path"):
        taxonomy.find("flat")
    assert taxonomy.find("b > flat").class_ids == (3, 4)
    assert [str(n) for n in taxonomy.find_all("Flat")] == ["a > flat", "b > flat"]
    assert taxonomy.find_all("round") == ()


def test_a_class_goes_before_groups_of_its_name():
    taxonomy = Taxonomy({"lamp": ["lamp", "torch"], "rest": ["cup"]})
    assert taxonomy.find("lamp").class_ids == (1,)
    assert taxonomy.find("lamp > lamp").leaf


def test_case_hyphens_and_spaces_do_not_make_another_name():
    taxonomy = Taxonomy({"a": ["tv-stand", "table_lamp"]})
    assert taxonomy.find("TV  stand").name == "tv-stand"
    assert taxonomy.relabelling({1: "Table lamp", 2: "tv_stand"}).tolist() == [0, 2, 1]
    with pytest.raises(FormatError, match="tv stand twice"):
        Taxonomy({"a": ["tv-stand", "TV stand"]})


@pytest.mark.parametrize("class_id", [-1, 0, 8])
def test_no_id_but_a_class_s_own_is_answered(taxonomy, class_id):
    for ask in (taxonomy.path, taxonomy.leaf, lambda i: taxonomy.common_ancestor(1, i)):
        with pytest.raises(FormatError, match=f"class id {class_id} is not in .* 1 to 7"):
            ask(class_id)


@pytest.mark.parametrize("wrong", [-1, 8])
def test_an_image_with_foreign_ids_is_refused(taxonomy, wrong):
    with pytest.raises(FormatError, match=f"class id {wrong} is not in"):
        taxonomy.level_ids(np.array([[0, 1], [wrong, 7]]), 1)


@pytest.mark.parametrize("suffix", [".json", ".yaml"])
def test_files_bring_back_the_same_tree(taxonomy, tmp_path, suffix):
    path = tmp_path / f"tree{suffix}"
    taxonomy.save(path)
    again = Taxonomy.load(path)
    assert again == taxonomy and again.digest == taxonomy.digest


def test_the_digest_follows_structure_and_ids_but_not_the_name(taxonomy):
    other_ids = Taxonomy(TREE, classes=taxonomy.classes[::-1])
    moved = Taxonomy({"large items": TREE["large items"], "tiny items": TREE["small items"]})
    assert Taxonomy(TREE, name="other").digest == taxonomy.digest
    assert len({taxonomy.digest, other_ids.digest, moved.digest}) == 3


def test_relabelling_goes_by_name(taxonomy):
    table = taxonomy.relabelling({7: "Cup", 2: "bed"})
    assert table.tolist() == [0, -1, 1, -1, -1, -1, -1, 5]


def test_relabelling_refuses_classes_outside_the_tree(taxonomy):
    with pytest.raises(FormatError, match=r"labels/classes.json: .* no class person"):
        taxonomy.relabelling({1: "bed", 2: "person"}, "labels/classes.json")
    with pytest.raises(FormatError, match=r"classes.json: class ids count from 1, got 0"):
        taxonomy.relabelling({0: "bed", 2: "cup"}, "labels/classes.json")


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({}, "two classes or more"),
        ({"a": {"b": {"c": {}}}}, "two classes or more"),
        ({"a": ["x", "y"], "b": ["x"]}, "'x' appears twice: a > x and b > x"),
        ({"a": ["x", "X"]}, "twice"),
        ({"a": ["x", "y"], "b": []}, "empty group 'b'"),
        ({"a": ["x", 3]}, "not a name"),
        ({"a": ["x", "void"]}, "reserved"),
        ({"a": "x"}, "mapping or a list"),
        ({"a > b": ["x", "y"]}, "separates"),
        ({"a": {"x": None, "y": 0}}, "empty group 'y'"),
        ({"a": ["x ", "y"]}, "surrounding space"),
        ({"a": ["x\ny", "z"]}, "line breaks"),
        ({"a": ["\x1b[31mx", "y"]}, "control characters"),
        ({"a": ["x" * 101, "y"]}, "it has 101 characters; shorten it to 100"),
        ({"a": ["x-y"], "b": ["x y"]}, "'x y' appears twice"),
    ],
)
def test_broken_trees_are_refused(tree, message):
    with pytest.raises(FormatError, match=message):
        Taxonomy(tree)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tree: {a: [x, y], a: [z]}", "'a' is given twice"),
        ("tree: [", "neither YAML nor JSON"),
        ("name: x", "needs 'tree', a mapping or a list"),
        ("tree: {a: [x, y]}\ncolour: 1", "unknown key colour"),
        ("tree: {a: [x, y]}\nclasses: [x, z]", "lacks the class"),
        ("tree: {a: [x, y]}\nlevels: [one]", "2 levels but 1"),
        ("tree: {a: [x, y]}\nlevels: [one, one]", "level name.* twice: one"),
        ("tree: {a: {yes: [x, y]}}", "True, which is not a name"),
        ("tree: {? [a, b] : [x, y]}", "cannot be a key"),
        ("tree: &a {b: *a}", "neither YAML nor JSON"),
        pytest.param("tree: " + "{a: " * 3000, "nests too deeply", id="deep"),
    ],
)
def test_broken_files_name_themselves(tmp_path, text, message):
    path = tmp_path / "tree.yaml"
    path.write_text(text)
    with pytest.raises(FormatError, match=message) as error:
        Taxonomy.load(path)
    assert str(path) in str(error.value)


def test_a_flat_tree_has_one_level():
    taxonomy = Taxonomy.flat(["a", "b", "c"])
    assert taxonomy.level_widths == (3,)
    assert taxonomy.local_ids[:, 0].tolist() == [0, 1, 2]
