"""The default grouper, which works offline with the built-in vocabulary."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from toolkit.semantics.taxonomy_building.grouper import Grouping, Question
from toolkit.semantics.taxonomy_building.names import distinct
from toolkit.semantics.taxonomy_building.partition import Branch, partition
from toolkit.semantics.taxonomy_building.vocabulary import SHAPES, Entry, ObjectVocabulary, built_in

# Ranges of the limits between sizes in metres. The limits are chosen within them to balance the
# groups: nothing above 0.4 m is small, and no bed is medium.
_SIZES = ("small", "medium", "large", "very large")
_LIMITS_M = ((0.25, 0.4), (0.7, 0.9), (1.7, 2.2))

# Distance between top-level nodes (kitchen and clothes); it is 1 below them (chairs and sofas).
_TOP_DISTANCE = 1.3


class RuleGrouper:
    """Groups items by a vocabulary; deterministic."""

    def __init__(self, vocabulary: ObjectVocabulary | None = None) -> None:
        self._vocabulary = built_in() if vocabulary is None else vocabulary
        self._functions = {f: n for n, f in enumerate(self._vocabulary.functions)}

    def group(self, question: Question, complaint: str = "") -> Grouping:
        """Group by size, function or shape; returns one group if the items do not differ.

        If the question gives names, every item is assigned to the name with the most matching
        words.
        """
        entries = {item: self._vocabulary.look_up(item) for item in sorted(question.items)}
        if question.groups:
            return _among(question.groups, entries)
        if question.clusters:
            return _named_clusters(question.clusters, entries)
        if question.aspect == "size":
            return _by_size(entries, question.max_groups)
        root = self._functions_of(entries) if question.aspect == "function" else _shapes(entries)
        groups: dict[str, tuple[str, ...]] = {}
        for branch in partition(root, question.max_groups):
            groups[distinct(branch.name or "other", groups)] = branch.items
        return groups

    def _functions_of(self, entries: Mapping[str, Entry]) -> Branch:
        order = sorted(entries, key=lambda item: self._functions[entries[item].function])
        return _nested("", order, lambda item: entries[item].function)


def _nested(
    name: str, items: Sequence[str], path: Callable[[str], tuple[str, ...]], depth: int = 0
) -> Branch:
    """Return the tree of items by path, in the given order; single children replace parents.

    The distance between nodes is larger at the top level.
    """
    parts: dict[str, list[str]] = {}
    for item in items:
        if depth < len(path(item)):
            parts.setdefault(path(item)[depth], []).append(item)
    if not parts:
        return Branch(name, tuple(items))
    children = [_nested(part, members, path, depth + 1) for part, members in parts.items()]
    if len(children) == 1:
        return children[0]
    return Branch(name, tuple(items), tuple(children), 1.0 if depth else _TOP_DISTANCE)


def _by_size(entries: Mapping[str, Entry], max_groups: int) -> Grouping:
    """Return groups from small to large, with the limits that balance them best."""
    sizes_m = sorted(entry.size_m for entry in entries.values())
    names = _SIZES if max_groups > 2 else ("small", "large")
    ranges = _LIMITS_M[: max_groups - 1] if max_groups > 2 else _LIMITS_M[1:2]

    def imbalance(limits_m: Sequence[float]) -> int:
        counts = Counter(sum(size > limit for limit in limits_m) for size in sizes_m)
        return sum(count**2 for count in counts.values())

    limits_m = min(itertools.product(*(_steps(sizes_m, *r) for r in ranges)), key=imbalance)
    groups: dict[str, list[str]] = {name: [] for name in names}
    for item in sorted(entries):
        groups[names[sum(entries[item].size_m > limit for limit in limits_m)]].append(item)
    return {name: tuple(items) for name, items in groups.items() if items}


def _steps(sizes_m: Sequence[float], low: float, high: float) -> list[float]:
    """Return the limits in a range that give different groups."""
    return [low, *sorted({size for size in sizes_m if low < size <= high})]


def _shapes(entries: Mapping[str, Entry]) -> Branch:
    """Return the tree of shapes, divided by size if a shape has several sizes."""
    paths: dict[str, tuple[str, ...]] = {}
    for shape in SHAPES:
        same_shape = [item for item in sorted(entries) if entries[item].shape == shape]
        same_shape.sort(key=lambda item: entries[item].size_m)
        for item, sizes in zip(same_shape, _comparatives(same_shape, entries), strict=True):
            paths[item] = (shape, *(f"{size} {shape}" for size in sizes))
    return _nested("shapes", list(paths), lambda item: paths[item])


def _comparatives(items: Sequence[str], entries: Mapping[str, Entry]) -> Sequence[tuple[str, ...]]:
    """Return ("smaller",) or ("larger",) for items sorted by size; () if all sizes are equal."""
    sizes = [entries[item].size_m for item in items]
    cuts = [n for n in range(1, len(sizes)) if sizes[n] > sizes[n - 1]]
    if not cuts:
        return [()] * len(items)
    middle = min(cuts, key=lambda n: abs(2 * n - len(sizes)))
    return [("smaller",)] * middle + [("larger",)] * (len(sizes) - middle)


def _named_clusters(clusters: Sequence[Sequence[str]], entries: Mapping[str, Entry]) -> Grouping:
    """Name each cluster by its most frequent shape, or by the two most frequent ones."""
    named: dict[str, tuple[str, ...]] = {}
    for cluster in clusters:
        shapes = [shape for shape, _ in _ranked(entries[item].shape for item in cluster)]
        names = [*shapes[:1], " and ".join(shapes[:2]), *shapes[1:], f"other {shapes[0]}"]
        free = [name for name in names if name not in named]
        numbered = (f"{names[0]} {n}" for n in itertools.count(2))
        name = free[0] if free else next(n for n in numbered if n not in named)
        named[name] = tuple(cluster)
    return named


def _ranked(values: Iterable[str]) -> list[tuple[str, int]]:
    return sorted(Counter(values).items(), key=lambda pair: (-pair[1], pair[0]))


def _among(names: Sequence[str], entries: Mapping[str, Entry]) -> Grouping:
    """Assign items to given names by matching words; items without a match to the last name."""
    groups: dict[str, list[str]] = {name: [] for name in names}
    for item, entry in entries.items():
        known = " ".join([item, entry.word, entry.shape, *entry.function]).casefold().split()
        scores = [sum(word in known for word in name.casefold().split()) for name in names]
        best = max(range(len(names)), key=lambda n: (scores[n], n if not any(scores) else -n))
        groups[names[best]].append(item)
    return {name: tuple(items) for name, items in groups.items() if items}
