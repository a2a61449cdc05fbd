"""From a list of class names to a balanced, narrow tree (H-III.A.2).

Size first (H-2), then function, as many levels as balance needs (H-3), then shape (H-6),
then the classes themselves.
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
from toolkit.semantics.taxonomy_parsing import folded
from toolkit.taxonomy_building.clustering import clusters_of, standardised, with_strays
from toolkit.taxonomy_building.critic import settle
from toolkit.taxonomy_building.grouper import Aspect, Grouper, Question
from toolkit.taxonomy_building.rules import RuleGrouper
from toolkit.taxonomy_building.shapes import ShapeProvider

_LEVEL_NAMES: dict[Aspect, str] = {"size": "size", "function": "function", "geometry": "shape"}

# From name to subtree; a class has an empty one.
_Groups = dict[str, Any]


@dataclass(frozen=True)
class BuildOptions:
    """How wide and deep a tree may be.

    Attributes:
        aspects: what each level is about, top first, without the classes' own; None for
            size, function (by `function_levels`), geometry.
        function_levels: None for as many as the number of classes needs.
        most_sizes: groups at most at the top; at least 2, as the next two.
        most_functions: groups at most in the first level of function, where people look for
            furniture, kitchen, electronics, ...
        most_groups: groups or classes at most under any other node, where meaning allows.
            Four fill two bits, and need the fewest one-hot channels (n / log n).
        listed: so many classes, and fewer, need no groups among them.
        rounds: how often a grouper is asked the same question, before the rules decide.
        name: of the tree.
    """

    aspects: tuple[Aspect, ...] | None = None
    function_levels: int | None = None
    most_sizes: int = 3
    most_functions: int = 5
    most_groups: int = 4
    listed: int = 3
    rounds: int = 3
    name: str = "taxonomy"

    def __post_init__(self) -> None:
        for field_name in ("most_sizes", "most_functions", "most_groups"):
            if getattr(self, field_name) < 2:
                raise ValueError(f"{field_name} must be at least 2")


def build_taxonomy(
    classes: Sequence[str],
    grouper: Grouper,
    shapes: ShapeProvider | None = None,
    options: BuildOptions | None = None,
    seed: int = 0,
) -> Taxonomy:
    """A tree with every class exactly once.

    The same names give the same tree in whatever order they come; the order decides only
    the class ids, which count from 1.

    Args:
        classes: names, each once.
        grouper: answers the questions of every node; what it leaves open the rules decide.
        shapes: what is known of the classes' shapes; without it, or where it knows too few
            of a node's classes, the grouper also sorts by shape.
        seed: of k-means++.

    Raises:
        FormatError: fewer than two classes, repeated names, or names that no tree can hold.
        ToolkitError: the grouper or the shapes cannot be had.
    """
    options = options or BuildOptions()
    # Refuses bad names before anything is asked.
    Taxonomy.flat(classes, options.name)
    aspects = options.aspects or _aspects(len(classes), options)
    known = standardised(shapes.embeddings(sorted(classes))) if shapes else {}
    functions, names = aspects.count("function"), {folded(c) for c in classes}
    growing = _Growing(options, functions, grouper, known, seed, names)
    tree = growing.grow(sorted(classes), aspects, ())
    # The check of the whole: every class exactly once, no empty group, no repeated sibling.
    return Taxonomy(tree, growing.level_names(), classes, options.name)


def _aspects(count: int, options: BuildOptions) -> tuple[Aspect, ...]:
    levels = options.function_levels
    if levels is None:
        # So many levels would hold all classes if every group were full. Size, shape and the
        # classes' own are three of them; one more than needed leaves room to keep together
        # what belongs together. Two at least: people ask for furniture, and in it for seats.
        full = math.ceil(math.log(count, options.most_groups) - 1e-9)
        levels = max(2, full - 2)
    functions: list[Aspect] = ["function"] * levels
    return ("size", *functions, "geometry")


@dataclass
class _Growing:
    """One tree while it grows.

    Attributes:
        function_levels: how many there are to be.
        shapes: standardised embeddings by class.
        class_names: folded; no group may be called like one.
        levels: for each level, how many classes stand under groups of each aspect.
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
        """The subtree of some classes, which begins with the first aspect that divides them."""
        if len(items) <= self.options.listed or not aspects:
            return {item: {} for item in items}
        groups = self._divided(items, aspects, path)
        if len(groups) == 1:
            return self.grow(items, aspects[1:], path)
        tree: _Groups = {}
        for name, members in groups.items():
            if len(members) == 1:  # a chain to a single class says nothing more than the class
                tree[members[0]] = {}
                continue
            self._count(len(path), aspects[0], len(members))
            tree[name] = self.grow(members, aspects[1:], (*path, name))
        return tree

    def level_names(self) -> list[str]:
        """A name for each level, by what most of its groups are about."""
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
        """Groups by the first aspect, those too large for the levels below divided again."""
        most = self._most(aspects)
        groups = self._asked(items, aspects[0], path, most)
        room = self.options.most_groups ** len(aspects)
        while len(groups) < most:
            largest = max(groups, key=lambda name: (len(groups[name]), name))
            if len(groups[largest]) <= room:
                break
            parts = self._asked(
                groups[largest], aspects[0], (*path, largest), most - len(groups) + 1
            )
            if len(parts) == 1 or {*map(folded, parts)} & {*map(folded, groups)}:
                break
            groups = {
                name: members
                for old, whole in groups.items()
                for name, members in (parts if old == largest else {old: whole}).items()
            }
        return groups

    def _asked(
        self, items: Sequence[str], aspect: Aspect, path: tuple[str, ...], most: int
    ) -> dict[str, tuple[str, ...]]:
        """The settled answer to one question, with names that can stand at this place."""
        question = Question(
            tuple(sorted(items)),
            aspect,
            path,
            most_groups=most,
            clusters=self._clusters(items, most) if aspect == "geometry" else (),
        )
        if isinstance(self.grouper, RuleGrouper):  # right as it is: there is nothing to settle
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

    def _clusters(self, items: Sequence[str], most: int) -> tuple[tuple[str, ...], ...]:
        """Clusters by measured shape, or none where too few classes have one."""
        known = {item: self.shapes[item] for item in items if item in self.shapes}
        if len(known) < 3:
            return ()
        clusters = clusters_of(known, most, self.options.most_groups, self.seed)
        if len(clusters) < 2:
            return ()
        strays = [item for item in items if item not in known]
        question = Question(tuple(sorted(items)), "geometry", most_groups=most)
        kin = tuple(self._rules.group(question).values()) if strays else ()
        return tuple(with_strays(clusters, strays, kin))

    def _most(self, aspects: Sequence[Aspect]) -> int:
        if aspects[0] == "size":
            return self.options.most_sizes
        if aspects[0] == "function" and aspects.count("function") == self.function_levels:
            return self.options.most_functions
        return self.options.most_groups

    def _count(self, level: int, aspect: Aspect, members: int) -> None:
        while len(self.levels) <= level:
            self.levels.append(Counter())
        self.levels[level][aspect] += members
