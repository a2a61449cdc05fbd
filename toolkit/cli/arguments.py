"""Command lines: parsed by tyro into dataclasses and validated, with errors on one line."""

from __future__ import annotations

import contextlib
import io
import itertools
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import tyro

from toolkit.cli.help import FLAGS, help_page
from toolkit.errors import SettingsError
from toolkit.options import suggestion, validated

Arguments = TypeVar("Arguments")


def parse_arguments(
    kind: type[Arguments], argv: Sequence[str], job: str, **options: Any
) -> Arguments:
    """The arguments of a program as a validated dataclass.

    Args:
        kind: dataclass of the arguments.
        argv: command line after the job's name.
        job: name of the job.
        options: passed to `tyro.cli`, for instance a default.

    Returns:
        The arguments. `--help` and `--help-all` print a help page instead and end the program.

    Raises:
        SettingsError: an option is unknown or a value is invalid; the message is one line.
        SystemExit: help was requested.
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
    """The message in the box that tyro prints, on one line; an unknown option with the nearest.

    The box is drawn in ASCII where stdout is ASCII.
    """
    lines = [line.strip("│ ") for line in box.splitlines()][1:]  # below the title
    if lines and not lines[0].strip("-"):
        del lines[0]
    # Up to the rule above the help text.
    message = itertools.takewhile(lambda line: line.strip("─- "), lines)
    text = " ".join(" ".join(message).split()).rstrip(".")
    unknown = re.match(r"Unrecognized options: (--([\w.-]+))", text)
    if unknown:
        key = unknown[2].replace("-", "_")
        return f"unknown option {unknown[1]}" + suggestion(kind, key, _flag)
    return text or "invalid arguments"
