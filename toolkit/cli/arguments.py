"""Command lines: tyro's parsing, with our one-line errors."""

from __future__ import annotations

import contextlib
import io
import itertools
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from toolkit.errors import SettingsError

Arguments = TypeVar("Arguments")


def parse_arguments(
    kind: type[Arguments], argv: Sequence[str], job: str, **options: Any
) -> Arguments:
    """Arguments of a program as an object of a dataclass or settings model.

    Args:
        kind: what to make. argv: the words after the job's name. job: its name.
        options: passed to `tyro.cli`, for instance a default.

    Raises:
        SettingsError: a word is unknown or a value wrong; one line.
        SystemExit: help was asked for and printed.
    """
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(kind, args=list(argv), prog=f"semsplat {job}", **options)
    except SystemExit as end:
        if not end.code:
            raise
    raise SettingsError(f"{_first_fault(box.getvalue())}; see: semsplat {job} --help")


def _first_fault(box: str) -> str:
    """The message of tyro's error in one line; its frame is of ASCII where stdout is."""
    lines = [line.strip("│ ") for line in box.splitlines()][1:]  # below the title
    if lines and not lines[0].strip("-"):
        del lines[0]
    # Up to the rule above the help text.
    message = itertools.takewhile(lambda line: line.strip("─- "), lines)
    text = " ".join(" ".join(message).split())
    text = re.sub(r" ?For further information visit \S+", "", text)
    text = re.sub(r" \[type=\w+, input_value=(.*?), input_type=\w+\]", r", got \1", text)
    return text.rstrip(".") or "wrong arguments"
