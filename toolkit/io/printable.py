"""Text from files and users that is shown in a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    """Return a text with escapes instead of control and invisible characters, on one line.

    Names in files can contain sequences that move the cursor, recolour the terminal or reverse the
    direction of writing.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
