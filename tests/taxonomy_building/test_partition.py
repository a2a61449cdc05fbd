"""Groups cut out of a tree of meanings."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.semantics.taxonomy_building.partition import (
    _JOINED,
    _SINGLE,
    _SPLIT,
    Branch,
    partition,
)


def branch(name: str, *children: Branch, items: int = 0, apart: float = 1.0) -> Branch:
    own = tuple(f"{name}{i}" for i in range(items))
    below = tuple(item for child in children for item in child.items)
    return Branch(name, own + below, tuple(children), apart)


def sizes(groups) -> dict[str, int]:
    return {group.name: len(group.items) for group in groups}


def test_the_children_are_the_groups_where_they_are_about_equal():
    root = branch("", branch("a", items=3), branch("b", items=4), branch("c", items=3))
    assert sizes(partition(root, 4)) == {"a": 3, "b": 4, "c": 3}


def test_a_large_child_is_replaced_by_its_parts():
    chairs, tables = branch("chairs", items=6), branch("tables", items=6)
    root = branch("", branch("furniture", chairs, tables), branch("kitchen", items=5))
    assert sizes(partition(root, 4)) == {"chairs": 6, "tables": 6, "kitchen": 5}


def test_small_neighbours_share_a_group():
    root = branch(
        "",
        *(branch(name, items=n) for name, n in [("a", 9), ("b", 2), ("c", 2), ("d", 9)]),
    )
    assert sizes(partition(root, 3)) == {"a": 9, "b and c": 4, "d": 9}


def test_only_neighbours_share_a_group():
    root = branch(
        "",
        *(branch(name, items=n) for name, n in [("a", 2), ("b", 9), ("c", 2), ("d", 9)]),
    )
    names = sizes(partition(root, 3))
    assert "a and c" not in names
    assert len(names) == 3


def test_many_shared_names_become_one():
    parts = [branch(name, items=2) for name in "abcd"]
    furniture = branch("furniture", *parts)
    root = branch("", furniture, branch("kitchen", items=8))
    assert sizes(partition(root, 2)) == {"furniture": 8, "kitchen": 8}
    loose = branch("", *parts, branch("kitchen", items=8))
    assert sizes(partition(loose, 2)) == {"other": 8, "kitchen": 8}


def test_without_parts_there_is_one_group():
    assert sizes(partition(branch("a", items=5), 4)) == {"a": 5}


@st.composite
def trees(draw, depth=3):
    """A tree whose inner nodes have two children or more."""
    names = iter(range(1000))

    def grow(level: int) -> Branch:
        name = f"n{next(names)} "
        if level == 0 or draw(st.booleans()):
            return branch(name, items=draw(st.integers(1, 6)))
        count = draw(st.integers(2, 4))
        return branch(name, *(grow(level - 1) for _ in range(count)))

    return branch("", *(grow(depth - 1) for _ in range(draw(st.integers(2, 4)))))


@given(trees(), st.integers(2, 6))
def test_every_item_is_in_one_group_and_groups_are_few(tree, most):
    groups = partition(tree, most)
    assert 2 <= len(groups) <= most
    assert sorted(i for g in groups for i in g.items) == sorted(tree.items)


def every_cut(branch: Branch, most: int, ideal: float, root: bool = False):
    """(cost, sizes) of every cut of a branch, by trying them all."""
    if not root:
        size = len(branch.items)
        yield (size / ideal - 1) ** 2 + (_SINGLE if size == 1 else 0.0), [size]
    if branch.children:
        for cost, sizes in every_row(branch.children, most, ideal, branch.distance):
            if 1 < len(sizes) <= most:
                yield cost + (0.0 if root else _SPLIT), sizes


def every_row(children, most, ideal, apart):
    if not children:
        yield 0.0, []
        return
    for run in range(1, len(children) + 1):
        joined = Branch("", tuple(i for c in children[:run] for i in c.items))
        heads = every_cut(children[0] if run == 1 else joined, most, ideal)
        for head_cost, head in list(heads):
            for cost, sizes in every_row(children[run:], most, ideal, apart):
                yield head_cost + _JOINED * apart * (run - 1) + cost, head + sizes


@settings(max_examples=40)
@given(trees(depth=2), st.integers(2, 4))
def test_no_cut_is_better(tree, most):
    ideal = max(len(tree.items) / most, 2.0)
    cuts = list(every_cut(tree, most, ideal, root=True))
    best = min(cost for cost, _ in cuts)
    chosen = [len(group.items) for group in partition(tree, most)]
    assert min(cost for cost, sizes in cuts if sizes == chosen) == pytest.approx(best)
