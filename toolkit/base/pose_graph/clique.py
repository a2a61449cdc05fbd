"""Maximum clique of a consistency graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def largest_clique(agree: NDArray[np.bool_], exact_up_to: int = 40) -> list[int]:
    """Return the ascending indices of the largest set whose members agree pairwise.

    The result is deterministic. Among sets of equal size, the lexicographically smallest one is
    returned, so the caller's order expresses a preference.

    Args:
        agree: [L, L] symmetric bool; the diagonal is ignored.
        exact_up_to: maximum L for the exact search, which is exponential in the worst case;
            larger sets are searched greedily.
    """
    neighbours = [set(np.flatnonzero(row).tolist()) - {k} for k, row in enumerate(agree)]
    if len(neighbours) > exact_up_to:
        return _greedy(neighbours)
    return _exact(neighbours)


def _exact(neighbours: list[set[int]]) -> list[int]:
    """Branch and bound: the number of colours of a graph bounds the size of its cliques."""
    best: list[int] = []

    def grow(current: list[int], candidates: list[int]) -> None:
        nonlocal best
        if len(current) > len(best):
            best = current
        for position, node in enumerate(candidates):
            remaining = candidates[position:]
            if len(current) + _colours(remaining, neighbours) <= len(best):
                return
            grow([*current, node], [c for c in remaining[1:] if c in neighbours[node]])

    grow([], list(range(len(neighbours))))
    return best


def _colours(nodes: list[int], neighbours: list[set[int]]) -> int:
    """Number of colours of a greedy colouring in which no two neighbours share a colour."""
    classes: list[list[int]] = []
    for node in nodes:
        for members in classes:
            if neighbours[node].isdisjoint(members):
                members.append(node)
                break
        else:
            classes.append([node])
    return len(classes)


def _greedy(neighbours: list[set[int]]) -> list[int]:
    """Repeatedly add the candidate that agrees with most remaining candidates."""
    chosen: list[int] = []
    candidates = set(range(len(neighbours)))
    while candidates:
        node = max(sorted(candidates), key=lambda k: len(neighbours[k] & candidates))
        chosen.append(node)
        candidates &= neighbours[node]
    return sorted(chosen)
