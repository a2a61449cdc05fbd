"""Wrong words on a command line end in one line that names them."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass

import pytest

from toolkit.cli.arguments import parse_arguments
from toolkit.errors import SettingsError
from toolkit.runs.settings import RunSettings


@dataclass(frozen=True)
class _Program:
    number: int = 1


def test_right_words_are_parsed():
    assert parse_arguments(_Program, ["--number", "3"], "job").number == 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--tracking.dense.levels", "9"], "--tracking.dense.levels: input should be less"),
        (["--nope", "3"], "unknown option --nope; see: semsplat run --help"),
        (
            ["--tracking.dense.level", "3"],
            "--tracking.dense.level; did you mean --tracking.dense.levels?",
        ),
        (["--max-frame=3"], "unknown option --max-frame; did you mean --max-frames?"),
        (["--seed", "x"], "--seed: invalid literal"),
        (["--seed", "-1"], "--seed: input should be greater than or equal to 0, got -1"),
        (["--hold-out", "1"], "--hold-out: input should be greater than or equal to 2, got 1"),
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


def test_help_is_no_error(capsys):
    with pytest.raises(SystemExit) as end:
        parse_arguments(_Program, ["--help"], "job")
    assert not end.value.code
    assert "--number" in capsys.readouterr().out
