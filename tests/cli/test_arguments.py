"""Wrong words on a command line end in one line that names them."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass

import pytest

from toolkit.base.errors import SettingsError
from toolkit.runs.settings import RunSettings
from toolkit.tools.cli import run
from toolkit.tools.cli.arguments import parse_arguments


@dataclass(frozen=True)
class _Program:
    number: int = 1


def test_right_words_are_parsed():
    assert parse_arguments(_Program, ["--number", "3"], "job").number == 3


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--placement.max-width", "9"], "--placement.max-width: input should be greater"),
        (["--nope", "3"], "unknown option --nope; see: semsplat run --help"),
        (
            ["--tracking.dense.width", "320"],
            "--tracking.dense.width; did you mean --tracking.dense.max-width?",
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


@pytest.mark.parametrize("joined", [False, True])
def test_preset_then_file_then_command_line(tmp_path, monkeypatch, joined):
    file = tmp_path / "settings.yaml"
    file.write_text("seed: 5\nmapping: {iterations: 9, final_iterations: 8}\n")
    given: list[RunSettings] = []
    monkeypatch.setattr("toolkit.runs.execution.run", lambda settings, *_: given.append(settings))
    flags = {"--preset": "hier-slam", "--config": str(file), "--mapping.iterations": "7"}
    words = [w for k, v in flags.items() for w in ([f"{k}={v}"] if joined else [k, v])]
    assert run.main(["--out", "out", *words]) == 0
    (settings,) = given
    assert settings.tracking.kind == "first-order"  # preset
    assert (settings.seed, settings.mapping.final_iterations) == (5, 8)  # file
    assert settings.mapping.iterations == 7  # command line


def test_an_unknown_preset_is_named():
    with pytest.raises(SettingsError, match="there is no preset 'nope'"):
        run.main(["--out", "out", "--preset", "nope"])
