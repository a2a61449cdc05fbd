"""The largest set of things that all agree with each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def largest_clique(agree: NDArray[np.bool_], exact_up_to: int = 40) -> list[int]:
    """Places, ascending, of the largest set whose members agree pairwise.

    The same answer each time: of equally large sets the one whose earliest members come
    first, so that the caller's order is a preference.

    Args:
        agree: [L, L] symmetric; the diagonal does not count.
        exact_up_to: beyond so many the search, exponential at worst, becomes greedy.

    Raises:
        ValueError: the matrix is not square and symmetric.
    """
    if agree.ndim != 2 or agree.shape[0] != agree.shape[1] or (agree != agree.T).any():
        raise ValueError(f"agreement must be a symmetric matrix, got shape {list(agree.shape)}")
    friends = [set(np.flatnonzero(row).tolist()) - {k} for k, row in enumerate(agree)]
    if len(friends) > exact_up_to:
        return _greedy(friends)
    return _exact(friends)


def _exact(friends: list[set[int]]) -> list[int]:
    """Branch and bound: a set cannot have more members than its graph needs colours."""
    best: list[int] = []

    def grow(current: list[int], candidates: list[int]) -> None:
        nonlocal best
        if len(current) > len(best):
            best = current
        for place, node in enumerate(candidates):
            remaining = candidates[place:]
            if len(current) + _colours(remaining, friends) <= len(best):
                return
            grow([*current, node], [c for c in remaining[1:] if c in friends[node]])

    grow([], list(range(len(friends))))
    return best


def _colours(nodes: list[int], friends: list[set[int]]) -> int:
    """Colours that suffice for no two friends to share one."""
    classes: list[list[int]] = []
    for node in nodes:
        for members in classes:
            if friends[node].isdisjoint(members):
                members.append(node)
                break
        else:
            classes.append([node])
    return len(classes)


def _greedy(friends: list[set[int]]) -> list[int]:
    """Always the candidate that leaves most of the others."""
    chosen: list[int] = []
    candidates = set(range(len(friends)))
    while candidates:
        node = max(sorted(candidates), key=lambda k: len(friends[k] & candidates))
        chosen.append(node)
        candidates &= friends[node]
    return sorted(chosen)
