"""Build a balanced, narrow tree from a list of class names (H-III.A.2).

The levels are size (H-2), function with as many levels as needed for balance (H-3), shape (H-6),
and class.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.clustering import (
    clusters_of,
    standardised,
    with_unmeasured,
)
from toolkit.semantics.taxonomy_building.critic import settle
from toolkit.semantics.taxonomy_building.grouper import Aspect, Grouper, Question
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.shapes import ShapeProvider
from toolkit.semantics.taxonomy_parsing import folded

_LEVEL_NAMES: dict[Aspect, str] = {"size": "size", "function": "function", "geometry": "shape"}

# Mapping from name to subtree; the subtree of a class is empty.
_Groups = dict[str, Any]


@dataclass(frozen=True)
class BuildOptions:
    """Options of the width and depth of a tree.

    Attributes:
        aspects: criterion of each level above the classes, top first; None for size, function
            (`function_levels` times) and geometry.
        function_levels: number of levels of function; None derives it from the number of classes.
        max_sizes: maximum number of groups at the top; at least 2, like the next two.
        max_functions: maximum number of groups at the first level of function (furniture,
            kitchen, electronics, ...).
        max_groups: target maximum number of children of any other node. Four use two bits, and
            give nearly the fewest one-hot channels (n / log n).
        listed: maximum number of classes that are not divided into groups.
        rounds: maximum number of times a grouper is asked the same question before the rules
            decide.
        name: name of the tree.
    """

    aspects: tuple[Aspect, ...] | None = None
    function_levels: int | None = None
    max_sizes: int = 3
    max_functions: int = 5
    max_groups: int = 4
    listed: int = 3
    rounds: int = 3
    name: str = "taxonomy"

    def __post_init__(self) -> None:
        for field_name in ("max_sizes", "max_functions", "max_groups"):
            if getattr(self, field_name) < 2:
                raise ValueError(f"{field_name} must be at least 2")


def build_taxonomy(
    classes: Sequence[str],
    grouper: Grouper,
    shapes: ShapeProvider | None = None,
    options: BuildOptions | None = None,
    seed: int = 0,
) -> Taxonomy:
    """Build a tree that contains every class exactly once.

    The tree does not depend on the order of the names. The order defines the class ids, which
    start at 1.

    Args:
        classes: distinct class names.
        grouper: divides the items of every node; the rules decide on items that it leaves out.
        shapes: shape embeddings of the classes; if they are missing for too many classes of a
            node, the grouper also divides by shape.
        options: width and depth of the tree.
        seed: seed of k-means++.

    Raises:
        FormatError: fewer than two classes, repeated names, or invalid names.
        ToolkitError: the grouper or the shapes are not available.
    """
    options = options or BuildOptions()
    # Rejects invalid names before the grouper is called.
    Taxonomy.flat(classes, options.name)
    aspects = options.aspects or _aspects(len(classes), options)
    known = standardised(shapes.embeddings(sorted(classes))) if shapes else {}
    functions, names = aspects.count("function"), {folded(c) for c in classes}
    builder = _TreeBuilder(options, functions, grouper, known, seed, names)
    tree = builder.grow(sorted(classes), aspects, ())
    # Taxonomy checks that every class appears once, and that no group is empty or repeated.
    return Taxonomy(tree, builder.level_names(), classes, options.name)


def _aspects(count: int, options: BuildOptions) -> tuple[Aspect, ...]:
    levels = options.function_levels
    if levels is None:
        # `full` levels contain all classes if every group is full. Size, shape and class are three
        # of them; an additional level avoids splitting semantic groups. Use at least two levels of
        # function, for instance furniture and seating.
        full = math.ceil(math.log(count, options.max_groups) - 1e-9)
        levels = max(2, full - 2)
    functions: list[Aspect] = ["function"] * levels
    return ("size", *functions, "geometry")


@dataclass
class _TreeBuilder:
    """Recursive construction of one tree.

    Attributes:
        options: width and depth of the tree.
        function_levels: number of levels of function.
        grouper: divides the items of a node.
        shapes: standardised embeddings by class.
        seed: seed of k-means++.
        class_names: normalised class names; groups must have other names.
        levels: for each level, the number of classes below groups of each aspect.
    """

    options: BuildOptions
    function_levels: int
    grouper: Grouper
    shapes: Mapping[str, NDArray[np.float64]]
    seed: int
    class_names: set[str]
    levels: list[Counter[Aspect]] = field(default_factory=list)
    _rules: RuleGrouper = field(default_factory=RuleGrouper)

    def grow(
        self, items: Sequence[str], aspects: Sequence[Aspect], path: tuple[str, ...]
    ) -> _Groups:
        """Return the subtree of some classes; starts with the first aspect that divides them."""
        if len(items) <= self.options.listed or not aspects:
            return {item: {} for item in items}
        groups = self._divided(items, aspects, path)
        if len(groups) == 1:
            return self.grow(items, aspects[1:], path)
        tree: _Groups = {}
        for name, members in groups.items():
            if len(members) == 1:  # a group with a single class is replaced by the class
                tree[members[0]] = {}
                continue
            self._count(len(path), aspects[0], len(members))
            tree[name] = self.grow(members, aspects[1:], (*path, name))
        return tree

    def level_names(self) -> list[str]:
        """Return a name for each level, by the most frequent aspect of its groups."""
        aspects = [_LEVEL_NAMES[level.most_common(1)[0][0]] for level in self.levels]
        seen: Counter[str] = Counter()
        names = []
        for name in aspects:
            seen[name] += 1
            names.append(f"{name} {seen[name]}" if aspects.count(name) > 1 else name)
        return [*names, "class"]

    def _divided(
        self, items: Sequence[str], aspects: Sequence[Aspect], path: tuple[str, ...]
    ) -> dict[str, tuple[str, ...]]:
        """Group by the first aspect; divide groups that are too large for the levels below."""
        max_groups = self._most(aspects)
        groups = self._asked(items, aspects[0], path, max_groups)
        capacity = self.options.max_groups ** len(aspects)
        while len(groups) < max_groups:
            largest = max(groups, key=lambda name: (len(groups[name]), name))
            if len(groups[largest]) <= capacity:
                break
            parts = self._asked(
                groups[largest], aspects[0], (*path, largest), max_groups - len(groups) + 1
            )
            if len(parts) == 1 or {*map(folded, parts)} & {*map(folded, groups)}:
                break
            groups = {
                name: members
                for old, old_members in groups.items()
                for name, members in (parts if old == largest else {old: old_members}).items()
            }
        return groups

    def _asked(
        self, items: Sequence[str], aspect: Aspect, path: tuple[str, ...], max_groups: int
    ) -> dict[str, tuple[str, ...]]:
        """Return the checked answer to one question, with names that are valid at this node."""
        question = Question(
            tuple(sorted(items)),
            aspect,
            path,
            max_groups=max_groups,
            clusters=self._clusters(items, max_groups) if aspect == "geometry" else (),
        )
        if isinstance(self.grouper, RuleGrouper):  # its answers are always valid
            groups = self.grouper.group(question)
        else:
            groups = settle(question, self.grouper, self._rules, self.options.rounds)
        reserved = self.class_names | {folded(name) for name in path}
        named: dict[str, tuple[str, ...]] = {}
        for name, members in groups.items():
            while folded(name) in reserved or folded(name) in map(folded, named):
                name = f"{name} group"
            named[name] = members
        return named

    def _clusters(self, items: Sequence[str], max_groups: int) -> tuple[tuple[str, ...], ...]:
        """Return clusters by measured shape, or none if too few classes have a shape."""
        known = {item: self.shapes[item] for item in items if item in self.shapes}
        if len(known) < 3:
            return ()
        clusters = clusters_of(known, max_groups, self.options.max_groups, self.seed)
        if len(clusters) < 2:
            return ()
        unmeasured = [item for item in items if item not in known]
        question = Question(tuple(sorted(items)), "geometry", max_groups=max_groups)
        similar = tuple(self._rules.group(question).values()) if unmeasured else ()
        return tuple(with_unmeasured(clusters, unmeasured, similar))

    def _most(self, aspects: Sequence[Aspect]) -> int:
        if aspects[0] == "size":
            return self.options.max_sizes
        if aspects[0] == "function" and aspects.count("function") == self.function_levels:
            return self.options.max_functions
        return self.options.max_groups

    def _count(self, level: int, aspect: Aspect, members: int) -> None:
        while len(self.levels) <= level:
            self.levels.append(Counter())
        self.levels[level][aspect] += members
