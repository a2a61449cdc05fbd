"""Trees without meaning, as narrow as a given one: what a tree is worth shows beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.semantics.taxonomy import Taxonomy


def random_taxonomy(like: Taxonomy, seed: int = 0) -> Taxonomy:
    """A tree of the same form, level widths and class ids, its classes put anywhere."""
    order = np.random.default_rng(seed).permutation(len(like))
    return _filled(like, [like.classes[i] for i in order], "random")


def alphabetical_taxonomy(like: Taxonomy) -> Taxonomy:
    """A tree of the same form, level widths and class ids, its classes put in by name."""
    return _filled(like, sorted(like.classes, key=str.casefold), "alphabetical")


def _filled(like: Taxonomy, classes: Sequence[str], kind: str) -> Taxonomy:
    """The tree with its leaves renamed in order, and groups that are numbered."""
    remaining = iter(classes)
    names: dict[tuple[str, ...], str] = {}
    root: dict[str, Any] = {}
    for number, node in enumerate(like.nodes):
        names[node.path] = next(remaining) if node.leaf else f"group {number}"
        branch = root
        for level in range(node.level):
            branch = branch[names[node.path[: level + 1]]]
        branch[names[node.path]] = {}
    return Taxonomy(root, like.levels, like.classes, f"{kind} {like.name}")
