"""Names of lengths in what people read: metres, or units if the scale of a map is not known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class LengthNames:
    """How lengths are written.

    Attributes:
        metric: whether lengths are metres; those of a camera without a known length are not.
    """

    metric: bool = True

    @classmethod
    def of_comments(cls, comments: Sequence[str]) -> LengthNames:
        """How lengths of a file are written, which has `notes` as comments or is in metres."""
        return cls(metric=set(comments).isdisjoint(cls(metric=False).notes))

    @property
    def length(self) -> str:
        """Name of the unit of length."""
        return "m" if self.metric else "units"

    @property
    def area(self) -> str:
        """Name of the unit of area."""
        return "m2" if self.metric else "square units"

    @property
    def notes(self) -> tuple[str, ...]:
        """One line that explains arbitrary units; none for metres."""
        if self.metric:
            return ()
        return (
            "lengths are in arbitrary units, because no length in the sequence is known; specify "
            "one with --scale",
        )

    @property
    def note_lines(self) -> tuple[str, ...]:
        """The notes as lines of a program's output."""
        return tuple(f"Note: {note}." for note in self.notes)


METRES = LengthNames()
