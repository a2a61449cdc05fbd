"""Wrong words on a command line end in one line that names them."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass

import pytest

from toolkit.cli.arguments import parse_arguments
from toolkit.errors import SettingsError
from toolkit.settings.run import RunSettings


@dataclass(frozen=True)
class _Program:
    number: int = 1


def test_right_words_are_parsed():
    assert parse_arguments(_Program, ["--number", "3"], "job").number == 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--mapping.iterations", "-3"], "iterations Input should be greater than or equal to 0"),
        (["--nope", "3"], "--nope"),
        (["--seed", "x"], "--seed: invalid literal"),
        (["--dataset.kind", "foo"], "'foo' for argument '--dataset.kind'"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_wrong_words_are_named_in_one_line(monkeypatch, words, named, encoding):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding))
    with pytest.raises(SettingsError) as error:
        parse_arguments(RunSettings, words, "run")
    message = str(error.value)
    assert named in message
    assert "\n" not in message
    assert message.endswith("; see: semsplat run --help")


def test_help_is_no_error(capsys):
    with pytest.raises(SystemExit) as end:
        parse_arguments(_Program, ["--help"], "job")
    assert not end.value.code
    assert "--number" in capsys.readouterr().out
