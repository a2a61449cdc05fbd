"""A few groups of about equal size, cut out of a tree of meanings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# What meaning costs against balance, in units of a group that is empty or twice too large.
_JOINED = 0.6  # per neighbour that shares a group: "seating and beds" says less than "seating"
_SPLIT = 0.3  # per meaning that is missing in the answer since its parts stand there instead
_ALONE = 0.4  # per group of one: it is no group


@dataclass(frozen=True)
class Branch:
    """A meaning, the items that have it, and the narrower meanings of all of them.

    Neighbouring children are nearer in meaning than distant ones.

    Attributes:
        name: may be empty at the root.
        apart: how far the children are from each other: 1 for kin, more for strangers.
    """

    name: str
    items: tuple[str, ...]
    children: tuple[Branch, ...] = ()
    apart: float = 1.0


@dataclass(frozen=True)
class _Cut:
    """Some groups and how far they are from equal."""

    cost: float
    groups: tuple[Branch, ...]

    def __add__(self, other: _Cut) -> _Cut:
        return _Cut(self.cost + other.cost, self.groups + other.groups)


# By number of groups, of which each has at least one.
_Cuts = dict[int, _Cut]


def partition(root: Branch, most: int) -> tuple[Branch, ...]:
    """At most `most` groups that hold all items of a tree of meanings, balanced.

    A group is a node of the tree or a few neighbours under one parent, so that no group mixes
    what the tree keeps far apart. Of these cuts the best is found exactly: the sum of squared
    distances from equal sizes plus a price for each meaning lost.

    Args:
        root: at least one item.
        most: at least two.

    Returns:
        Groups in the tree's order; the root alone where it has no parts.
    """
    if not root.children:
        return (root,)
    ideal = max(len(root.items) / most, 2.0)
    cuts = _side_by_side(root, most, ideal)
    # Of all in one group nothing is learnt; between equals, fewer groups are narrower.
    return min((cuts[n] for n in sorted(cuts) if n > 1), key=lambda cut: cut.cost).groups


def _cuts(branch: Branch, most: int, ideal: float) -> _Cuts:
    cuts: _Cuts = {1: _whole(branch, ideal)}
    if branch.children and most > 1:
        for count, cut in _side_by_side(branch, most, ideal).items():
            if count > 1:
                cuts[count] = _Cut(cut.cost + _SPLIT, cut.groups)
    return cuts


def _side_by_side(parent: Branch, most: int, ideal: float) -> _Cuts:
    """Cuts of a node's children, each by itself or joined with its neighbours."""
    children = parent.children
    alone = [_cuts(child, most, ideal) for child in children]
    best: list[_Cuts] = [{0: _Cut(0.0, ())}]  # of the first so many children
    for end in range(1, len(children) + 1):
        found: _Cuts = {}
        for start in range(end):
            joined = {1: _joined(parent, children[start:end], ideal)}
            for count, cut in (alone[start] if end - start == 1 else joined).items():
                for before, earlier in best[start].items():
                    total = before + count
                    if total > most:
                        continue
                    candidate = earlier + cut
                    if total not in found or candidate.cost < found[total].cost:
                        found[total] = candidate
        best.append(found)
    return best[-1]


def _joined(parent: Branch, neighbours: Sequence[Branch], ideal: float) -> _Cut:
    items = tuple(item for branch in neighbours for item in branch.items)
    cut = _whole(Branch(_name(parent, neighbours), items, tuple(neighbours)), ideal)
    return _Cut(cut.cost + _JOINED * parent.apart * (len(neighbours) - 1), cut.groups)


def _name(parent: Branch, neighbours: Sequence[Branch]) -> str:
    """ "beds and tables", or "other furniture" where the list would be long.

    Where the whole has no name, a single item beside groups is not worth a word, either:
    "kitchen and other".
    """
    several = [branch for branch in neighbours if len(branch.items) > 1]
    worthy = neighbours if parent.name or not several else several
    names = [name for b in worthy for name in b.name.replace(" and ", ", ").split(", ")]
    if len(names) > 3:
        return f"other {parent.name}" if parent.name else "other"
    names += ["other"] * (len(worthy) < len(neighbours))
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def _whole(branch: Branch, ideal: float) -> _Cut:
    size = len(branch.items)
    return _Cut((size / ideal - 1) ** 2 + (_ALONE if size == 1 else 0.0), (branch,))
