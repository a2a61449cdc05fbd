"""Names that are shown in a terminal cannot control it."""

from __future__ import annotations

import io
import logging

import pytest

from toolkit.base.printable import PrintableFormatter, PrintableStream, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Sofa, größer als 2 m — ソファ", "Sofa, größer als 2 m — ソファ"),
        ("\x1b[31mred", "\\x1b[31mred"),
        ("a\nb\tc\x07", "a\\nb\\tc\\x07"),
        ("left\u202eright\u200b", "left\\u202eright\\u200b"),
    ],
)
def test_control_and_invisible_characters_become_escapes(text, shown):
    assert printable(text) == shown


def test_streams_and_logs_keep_lines_and_tabs_only():
    stream = io.StringIO()
    print("a\tb\nc\x1b]0;title\x07", "\rd", file=PrintableStream(stream), flush=True)
    assert stream.getvalue() == "a\tb\nc\\x1b]0;title\\x07 \\rd\n"
    record = logging.LogRecord("toolkit", logging.INFO, "", 0, "class %s", ("\x1b[2Jbed",), None)
    assert PrintableFormatter("%(message)s").format(record) == "class \\x1b[2Jbed"
