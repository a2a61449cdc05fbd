"""The question that each node of a growing tree asks, and who may answer it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from toolkit.errors import ToolkitError

Aspect = Literal["size", "function", "geometry"]

# Group name to its items, in the answer's own order.
Grouping = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Question:
    """Sort items into named groups.

    Attributes:
        items: class names, each once, sorted.
        aspect: what the groups are to be about.
        path: names of the groups above, top first.
        groups: the names to choose from, or empty where the answer may invent them.
        most_groups: at most so many groups; at least two.
        clusters: for geometry alone: the sets of items that shape statistics found, which
            the answer only names; empty otherwise.
    """

    items: tuple[str, ...]
    aspect: Aspect
    path: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    most_groups: int = 6
    clusters: tuple[tuple[str, ...], ...] = ()


class UselessAnswerError(ToolkitError):
    """An answer came and is none: a refusal, broken JSON, cut off. To ask again may help."""


class Grouper(Protocol):
    """Answers questions, perhaps wrongly: the critic checks every answer."""

    def group(self, question: Question, complaint: str = "") -> Grouping:
        """Propose groups.

        Args:
            complaint: what was wrong with the last answer to the same question.

        Raises:
            UselessAnswerError: the answer is no grouping; the critic asks again.
            ToolkitError: no answer can be had (no network, no key); asking again is no use.
        """
        ...
