"""Trees from names: complete, narrow, the same each time, and of some meaning."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.semantics.trees import alphabetical_taxonomy, random_taxonomy
from toolkit.base.errors import FormatError
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.shapes import GivenShapes
from toolkit.semantics.taxonomy_building.vocabulary import built_in
from toolkit.semantics.taxonomy_parsing import folded

WORDS = [entry.word for entry in built_in()]
LISTS = Path(__file__).resolve().parents[2] / "benchmarks" / "data"


def rules_tree(classes, **options) -> Taxonomy:
    return build_taxonomy(classes, RuleGrouper(), options=BuildOptions(**options))


def binary_channels(taxonomy: Taxonomy) -> int:
    return sum(math.ceil(math.log2(width)) for width in taxonomy.level_widths)


@pytest.fixture(scope="module")
def replica() -> Taxonomy:
    return rules_tree(CLASS_NAMES, name="replica")


def test_replica_has_five_narrow_levels(replica):
    assert replica.levels == ("size", "function 1", "function 2", "shape", "class")
    assert sum(replica.level_widths) <= 20
    assert binary_channels(replica) <= 12
    assert replica.classes == CLASS_NAMES


@pytest.mark.parametrize(
    ("first", "second", "group"),
    [
        ("chair", "sofa", "seating"),
        ("table", "desk", "legged"),
        ("wall", "floor", "larger flat"),
        ("wall", "door", "building parts"),
        ("cup", "plate", "tableware"),
        ("bed", "sofa", "furniture"),
        ("toilet", "sink", "sanitary fixtures"),
        ("laptop", "phone", "electronics"),
    ],
)
def test_what_belongs_together_stands_together(replica, first, second, group):
    ids = [CLASS_NAMES.index(name) + 1 for name in (first, second)]
    node = replica.common_ancestor(*ids)
    assert node is not None and node.name == group


def test_no_bed_is_small_for_balance_s_sake(replica):
    size = {name: replica.path(i)[0] for i, name in enumerate(CLASS_NAMES, start=1)}
    assert {size[n] for n in ("bed", "sofa", "wall", "wardrobe", "table")} == {"large"}
    assert {size[n] for n in ("cup", "switch", "book", "mouse", "toothbrush")} == {"small"}


@pytest.mark.parametrize(("name", "one_hot", "binary"), [("200", 22, 13), ("550", 36, 18)])
def test_long_lists_stay_narrow(name, one_hot, binary):
    classes = (LISTS / f"objects_{name}.txt").read_text("utf-8").splitlines()
    assert len(classes) == len({folded(c) for c in classes}) == int(name)
    taxonomy = rules_tree(classes)
    assert sorted(taxonomy.classes) == sorted(classes)
    assert sum(taxonomy.level_widths) <= one_hot
    assert binary_channels(taxonomy) <= binary


def inner_nodes(taxonomy: Taxonomy) -> Iterator[tuple[tuple[str, ...], int]]:
    """Paths of groups, the root's included, and how many children each has."""
    for path in [(), *(n.path for n in taxonomy.nodes if not n.leaf)]:
        yield path, sum(n.path[:-1] == path for n in taxonomy.nodes)


@settings(max_examples=30)
@given(
    st.lists(
        st.one_of(st.sampled_from(WORDS), st.text("abcdefg ", min_size=1, max_size=9)),
        min_size=2,
        max_size=50,
        unique_by=folded,
    ).filter(lambda names: all(folded(n) and n == n.strip() for n in names)),
    st.randoms(),
)
def test_any_list_makes_a_sound_tree_whatever_its_order(names, random):
    taxonomy = rules_tree(names)
    assert list(taxonomy.classes) == names
    for path, children in inner_nodes(taxonomy):
        assert children >= 2 or not path, f"{path} is a chain"
        assert len({folded(name) for name in path}) == len(path), f"{path} repeats a label"
    groups = {folded(n.name) for n in taxonomy.nodes if not n.leaf}
    assert not groups & {folded(name) for name in names}
    shuffled = names.copy()
    random.shuffle(shuffled)
    # Paths, not mappings, which are equal in any order: local ids go by it.
    assert [n.path for n in rules_tree(shuffled).nodes] == [n.path for n in taxonomy.nodes]


class Stubborn:
    """Answers every question with one group each of half the items."""

    def group(self, question, complaint=""):
        half = len(question.items) // 2
        return {
            "first": question.items[:half],
            question.path[-1] if question.path else "x": [*question.items[half:]],
        }


def test_labels_that_repeat_on_a_path_are_renamed():
    taxonomy = build_taxonomy([f"thing {i}" for i in range(40)], Stubborn())
    assert len(taxonomy) == 40
    for node in taxonomy.nodes:
        assert len({folded(name) for name in node.path}) == len(node.path)


class Lopsided:
    """Puts nearly everything into one group, and calls it otherwise when asked again."""

    def group(self, question, complaint=""):
        if question.path and question.path[-1] == "Most":
            half = len(question.items) // 2
            return {"MOST": question.items[:half], "few": question.items[half:]}
        return {"Most": question.items[:-1], "Few": question.items[-1:]}


def test_a_group_too_large_is_divided_unless_names_would_clash():
    taxonomy = build_taxonomy([f"thing {i}" for i in range(80)], Lopsided())
    for path, _ in inner_nodes(taxonomy):
        siblings = [folded(n.name) for n in taxonomy.nodes if n.path[:-1] == path]
        assert len(set(siblings)) == len(siblings)


def test_a_group_is_never_called_like_a_class():
    taxonomy = rules_tree([*CLASS_NAMES, "furniture", "kitchen", "seating"])
    groups = {n.name for n in taxonomy.nodes if not n.leaf}
    assert groups.isdisjoint(taxonomy.classes)


def test_shapes_decide_the_geometry_level_where_they_are_known():
    # Four cabinets that names alone split by size: their shapes say otherwise.
    classes = ["base-cabinet", "wall-cabinet", "tv-stand", "wardrobe", "lamp", "cup"]
    options = BuildOptions(aspects=("function", "geometry"), max_functions=3)
    shapes = GivenShapes(
        {"base-cabinet": [0, 1], "tv-stand": [0, 1.1], "wall-cabinet": [9, 5], "Wardrobe": [9, 5.2]}
    )

    def parent(name: str, taxonomy: Taxonomy) -> str:
        return taxonomy.find(name).path[-2]

    by_name = build_taxonomy(classes, RuleGrouper(), options=options)
    by_shape = build_taxonomy(classes, RuleGrouper(), shapes, options)
    assert parent("base-cabinet", by_name) == parent("wall-cabinet", by_name)
    assert parent("base-cabinet", by_shape) == parent("tv-stand", by_shape)
    assert parent("wall-cabinet", by_shape) == parent("wardrobe", by_shape)
    assert by_shape == build_taxonomy(classes, RuleGrouper(), shapes, options)


def test_classes_without_a_shape_join_what_their_names_resemble():
    rng = np.random.default_rng(0)
    classes = ["shelf", "bookshelf", "cart", "rack", "stand", "hand truck", "umbrella"]
    vectors = {n: rng.normal(0, 0.1, 3) for n in classes[:3]}
    vectors |= {n: rng.normal(5, 0.1, 3) for n in classes[3:5]}
    options = BuildOptions(aspects=("function", "geometry"))
    taxonomy = build_taxonomy(classes, RuleGrouper(), GivenShapes(vectors), options)
    assert taxonomy.find("hand truck").path[:-1] == taxonomy.find("rack").path[:-1]


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ([], "two classes or more"),
        (["chair"], "two classes or more"),
        (["chair", "table", "Chair"], "twice"),
        (["tv-stand", "tv stand"], "twice"),
        (["chair", "void"], "reserved"),
        (["chair", " "], "not a name"),
        (["a > b", "c"], "separates"),
    ],
)
def test_lists_that_make_no_tree_are_refused(classes, message):
    with pytest.raises(FormatError, match=message):
        rules_tree(classes)


def test_two_classes_are_a_tree():
    assert rules_tree(["chair", "table"]).level_widths == (2,)


@pytest.mark.parametrize("make", [random_taxonomy, alphabetical_taxonomy])
def test_trees_to_compare_with_have_the_same_form_and_ids(replica, make):
    other = make(replica)
    assert other.level_widths == replica.level_widths
    assert other.levels == replica.levels
    assert other.classes == replica.classes
    assert sorted(map(tuple, other.local_ids)) == sorted(map(tuple, replica.local_ids))
    assert other != replica and make(replica) == other


def test_random_trees_differ_by_seed_and_alphabetical_ones_are_in_order(replica):
    assert random_taxonomy(replica, 1) != random_taxonomy(replica, 2)
    leaves = [n.name for n in alphabetical_taxonomy(replica).nodes if n.leaf]
    assert leaves == sorted(CLASS_NAMES)
