"""Help pages: short, complete on request, and without loading what the jobs need to run."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from tyro.conf import Positional

from toolkit.base.options import Fraction, PositiveInt, nested_options
from toolkit.tools.cli.help import COMMON, help_page
from toolkit.tools.cli.live import LiveProgram
from toolkit.tools.cli.main import JOBS, main
from toolkit.tools.cli.programs import PROGRAMS
from toolkit.tools.cli.run import RunProgram

KINDS = {**PROGRAMS, "run": RunProgram, "live": LiveProgram}


@dataclass(frozen=True)
class _Inner:
    """Options of the
    inner part.

    More about it.
    """

    levels: PositiveInt = 4
    """Number of levels."""
    use: bool = True
    """Use them."""


@dataclass(frozen=True)
class _Program:
    """Do something."""

    run: Positional[Path]
    """Run folder."""
    out: Path
    """File to write."""
    share: Fraction | None = None
    """Share in 100 %."""
    inner: _Inner = _Inner(levels=2)
    size: tuple[int, int] = (4, 3)
    """Width and height."""


def flags_of(page: str) -> list[str]:
    return re.findall(r"^  (--[\w.-]+)", page, flags=re.MULTILINE)


def test_a_page_shows_flags_types_defaults_and_ranges(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    lines = [" ".join(line.split()) for line in help_page(_Program, "job").splitlines()]
    assert lines[0] == "usage: semsplat job RUN --out PATH [OPTIONS]"
    assert "Do something." in lines
    assert "RUN Run folder. (required)" in lines
    assert "--out PATH File to write. (required)" in lines
    assert "--share FLOAT Share in 100 %. (range: [0, 1])" in lines
    assert "--size INT INT Width and height. (default: 4 3)" in lines
    # The default is that of the program, not of the nested class.
    assert "--inner.levels INT Number of levels. (default: 2, range: >= 1)" in lines
    assert "--inner.use, --inner.no-use" in lines
    assert lines[lines.index("inner:") + 1] == "Options of the inner part."


def test_the_help_of_run_fits_on_a_screen(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "100")
    assert main(["run", "--help"]) == 0
    page = capsys.readouterr().out
    assert len(page.splitlines()) <= 60
    assert 15 <= len(flags_of(page)) <= 25
    for flag in ("--dataset.path", "--out", "--image-size", "--max-frames", "--depth", "--map"):
        assert flag in flags_of(page)
    assert "--help-all" in page
    # Many choices are listed behind the description instead of in the placeholder.
    assert "--dataset.kind KIND " in page and "One of synthetic," in page


@pytest.mark.parametrize("job", sorted(KINDS))
def test_all_options_are_listed_on_request(capsys, job):
    assert main([job, "--help-all"]) == 0
    page = capsys.readouterr().out
    options = nested_options(KINDS[job])
    names = {option.key.replace("_", "-") for option in options}
    positional = {option.key for option in options if option.key.upper() in page.split("\n\n")[0]}
    assert {flag[2:] for flag in flags_of(page)} >= names - {
        p.replace("_", "-") for p in positional
    }


@pytest.mark.parametrize("job", sorted(KINDS))
def test_every_argument_of_a_job_is_described_by_a_complete_phrase(job):
    for option in nested_options(KINDS[job]):
        assert option.description[:1].isupper(), option.key
        assert option.description.endswith("."), option.key


def test_common_options_exist():
    for job, groups in COMMON.items():
        keys = {option.key for option in nested_options(KINDS[job])}
        assert {key for group in groups.values() for key in group} <= keys


def test_every_job_with_arguments_has_a_help_page():
    assert set(KINDS) == set(JOBS) - {"doctor"}
