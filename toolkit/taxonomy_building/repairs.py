"""What the critic had to mend in the answers to one question."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, fields

from toolkit.taxonomy_building.grouper import Question

logger = logging.getLogger(__name__)

_SHOWN = 3  # of a list that may be long


@dataclass
class Repairs:
    """Every way in which answers were wrong; empty lists for a right one.

    Attributes:
        useless: answers that were none, by their reason.
        invented: items that nobody asked about, dropped.
        renamed: items written otherwise than asked, put back as "written -> asked".
        repeated: items put in a second group, or twice in one; the first place counts.
        labels: names of groups that were changed, as "written -> used", or refused.
        surplus: groups beyond the number allowed; their items were asked about again.
        undivided: how often one group held everything, and was refused.
        asked_again: items that were left out, once for each time.
        by_fallback: what the fallback placed or named in the end.
    """

    useless: list[str] = field(default_factory=list)
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
        """One line: a warning where the fallback had to help, else for those who ask."""
        if str(self) == "nothing":
            return
        where = " > ".join(question.path) or "the top"
        level = logging.WARNING if self.by_fallback else logging.INFO
        logger.log(
            level,
            "%d items by %s at %s: repaired %s",
            len(question.items),
            question.aspect,
            where,
            self,
        )


def _clipped(text: str) -> str:
    """A part of an answer, fit for one line of a log."""
    line = repr(text)[1:-1]
    return line if len(line) <= 80 else line[:77] + "..."
