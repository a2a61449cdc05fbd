"""Partition a semantic hierarchy into a few groups of similar size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# Costs relative to the imbalance of a group that is empty or twice too large.
_JOINED = 0.6  # per sibling merged into a group: "seating and beds" is less specific than "seating"
_SPLIT = 0.3  # per node that is replaced by groups of its descendants
_SINGLE = 0.4  # per group with a single item


@dataclass(frozen=True)
class Branch:
    """A node of the semantic hierarchy.

    Neighbouring children are closer in meaning than distant ones.

    Attributes:
        name: name of the node; may be empty at the root.
        items: items below the node.
        children: more specific nodes with the same items.
        distance: semantic distance between the children: 1 for related ones, more for others.
    """

    name: str
    items: tuple[str, ...]
    children: tuple[Branch, ...] = ()
    distance: float = 1.0


@dataclass(frozen=True)
class _Cut:
    """Some groups and their total cost."""

    cost: float
    groups: tuple[Branch, ...]

    def __add__(self, other: _Cut) -> _Cut:
        return _Cut(self.cost + other.cost, self.groups + other.groups)


# Best cut by number of groups.
_Cuts = dict[int, _Cut]


def partition(root: Branch, max_groups: int) -> tuple[Branch, ...]:
    """Partition a semantic hierarchy into at most `max_groups` balanced groups.

    A group is a node of the tree, or adjacent children of one node. The optimum is found by dynamic
    programming. The cost is the sum of squared relative deviations from equal sizes, plus costs
    for merged and split nodes and single items.

    Args:
        root: node with at least one item.
        max_groups: maximum number of groups, at least two.

    Returns:
        Groups in the order of the tree; the root alone if it has no children.
    """
    if not root.children:
        return (root,)
    ideal = max(len(root.items) / max_groups, 2.0)
    cuts = _children_cuts(root, max_groups, ideal)
    # A single group divides nothing; of equal costs, the fewest groups give the smallest code.
    return min((cuts[n] for n in sorted(cuts) if n > 1), key=lambda cut: cut.cost).groups


def _cuts(branch: Branch, max_groups: int, ideal: float) -> _Cuts:
    cuts: _Cuts = {1: _single_group(branch, ideal)}
    if branch.children and max_groups > 1:
        for count, cut in _children_cuts(branch, max_groups, ideal).items():
            if count > 1:
                cuts[count] = _Cut(cut.cost + _SPLIT, cut.groups)
    return cuts


def _children_cuts(parent: Branch, max_groups: int, ideal: float) -> _Cuts:
    """Return the best cuts of a node's children, separate or merged with their neighbours."""
    children = parent.children
    separate = [_cuts(child, max_groups, ideal) for child in children]
    best: list[_Cuts] = [{0: _Cut(0.0, ())}]  # best[n] are the cuts of the first n children
    for end in range(1, len(children) + 1):
        found: _Cuts = {}
        for start in range(end):
            joined = {1: _joined(parent, children[start:end], ideal)}
            for count, cut in (separate[start] if end - start == 1 else joined).items():
                for before, earlier in best[start].items():
                    total = before + count
                    if total > max_groups:
                        continue
                    candidate = earlier + cut
                    if total not in found or candidate.cost < found[total].cost:
                        found[total] = candidate
        best.append(found)
    return best[-1]


def _joined(parent: Branch, neighbours: Sequence[Branch], ideal: float) -> _Cut:
    items = tuple(item for branch in neighbours for item in branch.items)
    cut = _single_group(Branch(_name(parent, neighbours), items, tuple(neighbours)), ideal)
    return _Cut(cut.cost + _JOINED * parent.distance * (len(neighbours) - 1), cut.groups)


def _name(parent: Branch, neighbours: Sequence[Branch]) -> str:
    """Return a name such as "beds and tables", or "other furniture" for more than three names.

    If the parent has no name, single items are summarised as "other": "kitchen and other".
    """
    several = [branch for branch in neighbours if len(branch.items) > 1]
    named = neighbours if parent.name or not several else several
    names = [name for b in named for name in b.name.replace(" and ", ", ").split(", ")]
    if len(names) > 3:
        return f"other {parent.name}" if parent.name else "other"
    names += ["other"] * (len(named) < len(neighbours))
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def _single_group(branch: Branch, ideal: float) -> _Cut:
    size = len(branch.items)
    return _Cut((size / ideal - 1) ** 2 + (_SINGLE if size == 1 else 0.0), (branch,))
