"""Text from files and users that is shown in a terminal."""

from __future__ import annotations

import logging
from typing import Any, TextIO


def printable(text: str) -> str:
    """Return a text with escapes instead of control and invisible characters, on one line.

    Names in files can contain sequences that move the cursor, recolour the terminal or reverse the
    direction of writing.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def printable_lines(text: str) -> str:
    """Return a text of several lines with such escapes; line breaks and tabs are kept."""
    if all(line.isprintable() for line in text.split("\n")):
        return text
    return "".join(c if c in "\n\t" else printable(c) for c in text)


class PrintableFormatter(logging.Formatter):
    """Formats log records with such escapes."""

    def format(self, record: logging.LogRecord) -> str:
        """The text of a record."""
        return printable_lines(super().format(record))


class PrintableStream:
    """Writes texts with such escapes to another stream; everything else is that of the stream."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text."""
        self._stream.write(printable_lines(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
