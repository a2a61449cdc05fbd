"""Names that are shown in a terminal cannot control it."""

from __future__ import annotations

import pytest

from toolkit.io.printable import printable


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
