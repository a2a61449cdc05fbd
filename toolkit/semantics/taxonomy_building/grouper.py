"""Interface of groupers, which divide the items of a node into groups."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from toolkit.base.errors import ToolkitError

Aspect = Literal["size", "function", "geometry"]

# Mapping from group name to items, in the order of the answer.
Grouping = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Question:
    """A request to divide items into named groups.

    Attributes:
        items: distinct class names, sorted.
        aspect: criterion of the groups.
        path: names of the groups above, top first.
        groups: permitted names of groups; empty if the grouper chooses the names.
        max_groups: maximum number of groups, at least two.
        clusters: for geometry only: sets of items clustered by shape statistics, which only need
            names; empty otherwise.
    """

    items: tuple[str, ...]
    aspect: Aspect
    path: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    max_groups: int = 6
    clusters: tuple[tuple[str, ...], ...] = ()


class InvalidAnswerError(ToolkitError):
    """An answer is not a grouping (refusal, invalid JSON, truncated); a retry may succeed."""


class Grouper(Protocol):
    """Proposes groups. Proposals can be wrong; the critic checks them."""

    def group(self, question: Question, complaint: str = "") -> Grouping:
        """Propose groups.

        Args:
            question: the items and the criterion.
            complaint: errors in the previous answer to the same question.

        Raises:
            InvalidAnswerError: the answer is not a grouping; the critic retries.
            ToolkitError: the grouper is not available (no network, no key).
        """
        ...
