"""Baseline trees with the structure of a given tree but without semantic grouping."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.semantics.taxonomy import Taxonomy


def random_taxonomy(like: Taxonomy, seed: int = 0) -> Taxonomy:
    """Return a tree of the same structure and class ids, with randomly assigned classes."""
    order = np.random.default_rng(seed).permutation(len(like))
    return _filled(like, [like.classes[i] for i in order], "random")


def alphabetical_taxonomy(like: Taxonomy) -> Taxonomy:
    """Return a tree of the same structure and class ids, with classes in alphabetical order."""
    return _filled(like, sorted(like.classes, key=str.casefold), "alphabetical")


def _filled(like: Taxonomy, classes: Sequence[str], kind: str) -> Taxonomy:
    """Return the tree with the leaves renamed in order and numbered groups."""
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
