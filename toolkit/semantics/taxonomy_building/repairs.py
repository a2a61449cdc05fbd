"""Record of the errors that the critic corrected in the answers to one question."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, fields

from toolkit.semantics.taxonomy_building.grouper import Question

logger = logging.getLogger(__name__)

_SHOWN = 3  # maximum number of list entries in a log line


@dataclass
class Repairs:
    """Corrected errors by kind; empty for a correct answer.

    Attributes:
        invalid: reasons of answers that were not groupings.
        invented: dropped items that are not in the question.
        renamed: items with a different spelling, as "written -> correct".
        repeated: items that appear more than once; the first group counts.
        labels: names of groups that were changed or refused, as "written -> used".
        surplus: groups above the maximum number; their items were asked about again.
        undivided: number of rejected answers with a single group.
        asked_again: items missing in an answer, once per answer.
        by_fallback: items assigned or groups named by the fallback.
    """

    invalid: list[str] = field(default_factory=list)
    invented: list[str] = field(default_factory=list)
    renamed: list[str] = field(default_factory=list)
    repeated: list[str] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    surplus: list[str] = field(default_factory=list)
    undivided: int = 0
    asked_again: list[str] = field(default_factory=list)
    by_fallback: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        parts = []
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, list) and value:
                shown = ", ".join(_clipped(v) for v in value[:_SHOWN])
                more = ", ..." if len(value) > _SHOWN else ""
                parts.append(f"{len(value)} {each.name.replace('_', ' ')} ({shown}{more})")
            elif value:
                parts.append(f"{value} {each.name}")
        return ", ".join(parts) or "nothing"

    def log(self, question: Question) -> None:
        """Log one line: a warning if the fallback was used, else at level INFO."""
        if str(self) == "nothing":
            return
        where = " > ".join(question.path) or "the top"
        level = logging.WARNING if self.by_fallback else logging.INFO
        logger.log(
            level,
            "Grouped %d items by %s at %s; corrected %s",
            len(question.items),
            question.aspect,
            where,
            self,
        )


def _clipped(text: str) -> str:
    """Return a part of an answer, escaped and truncated for a log line."""
    line = repr(text)[1:-1]
    return line if len(line) <= 80 else line[:77] + "..."
