"""Parse command lines into validated dataclasses with tyro; errors are one line."""

from __future__ import annotations

import contextlib
import io
import itertools
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from toolkit.base.errors import SettingsError
from toolkit.base.options import suggestion, validated
from toolkit.tools.cli.help import FLAGS, help_page

Arguments = TypeVar("Arguments")


def parse_arguments(
    kind: type[Arguments], argv: Sequence[str], job: str, **options: Any
) -> Arguments:
    """Parse the arguments of a job into a validated dataclass.

    Args:
        kind: dataclass of the arguments.
        argv: command line after the name of the job.
        job: name of the job.
        options: passed to `tyro.cli`, for instance a default.

    Raises:
        SettingsError: an option is unknown or a value is invalid; the message is one line.
        SystemExit: help was requested and printed.
    """
    if FLAGS & set(argv):
        print(help_page(kind, job, "--help-all" in argv), end="")
        raise SystemExit(0)
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            parsed = tyro.cli(kind, args=list(argv), prog=f"semsplat {job}", **options)
    except SystemExit as end:
        if not end.code:
            raise
        message = _first_error(errors.getvalue(), kind)
        raise SettingsError(f"{message}; see: semsplat {job} --help") from None
    return validated(kind, parsed, shown=_flag)


def _flag(key: str) -> str:
    return "--" + key.replace("_", "-")


def _first_error(box: str, kind: type) -> str:
    """Extract the message from the box that tyro prints, as one line.

    The message for an unknown option proposes the most similar one. The box is drawn with ASCII
    characters if stdout is ASCII.
    """
    lines = [line.strip("│ ") for line in box.splitlines()][1:]  # without the title
    if lines and not lines[0].strip("-"):
        del lines[0]
    # The message ends at the horizontal line above the help text.
    message = itertools.takewhile(lambda line: line.strip("─- "), lines)
    text = " ".join(" ".join(message).split()).rstrip(".")
    unknown = re.match(r"Unrecognized options: (--([\w.-]+))", text)
    if unknown:
        key = unknown[2].replace("-", "_")
        return f"unknown option {unknown[1]}" + suggestion(kind, key, _flag)
    return text or "invalid arguments"
