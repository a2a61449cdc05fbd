"""The documentation is true: Python blocks run, commands parse, files and options exist."""

from __future__ import annotations

import argparse
import functools
import importlib
import re
import runpy
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import documentation
import numpy as np
import pytest
import tyro
from documentation import PAGES, ROOT, Block, Command

import toolkit
from toolkit.tools.cli import run as run_program
from toolkit.tools.cli.arguments import parse_arguments
from toolkit.tools.cli.help import option_names
from toolkit.tools.cli.main import JOBS
from toolkit.tools.cli.programs import PROGRAMS

sys.path.insert(0, str(ROOT / "docs"))

from generate_reference import (
    GENERATED,
    api_page,
    job_options,
    markdown_docstring,
    options_page,
    rooms,
    rooms_page,
)

# Those that change the checkout are followed in `test_extending.py`.
RUNNING = [page for page in PAGES if not documentation.changes(page)]
BLOCKS = [block for page in RUNNING for block in documentation.blocks(page)]
PYTHON_BLOCKS = [block for block in BLOCKS if block.language == "python"]
GENERATED_PAGES = {ROOT / "docs" / page for page in GENERATED}
COMMANDS = [command for page in RUNNING for command in documentation.commands(page)]


class ParsedError(Exception):
    """The command line was parsed; what it asks for is not done."""


def stop_after(parse: Callable[..., Any]) -> Callable[..., Any]:
    def parsed(*args: Any, **options: Any) -> Any:
        parse(*args, **options)
        raise ParsedError

    return parsed


@pytest.fixture(scope="module")
def workspace(tmp_path_factory, tiny_recording, tiny_run) -> Path:
    """A folder with a recording in `mine` and a finished run in `runs/demo`."""
    folder = tmp_path_factory.mktemp("documentation")
    (folder / "mine").symlink_to(tiny_recording)
    (folder / "runs").mkdir()
    (folder / "runs" / "demo").symlink_to(tiny_run)
    return folder


@functools.cache
def camera_images() -> list[tuple[float, np.ndarray, np.ndarray]]:
    """What the driver of a camera delivers: time, colour, depth in millimetres."""
    depth_mm = np.full((240, 320), 2000, np.uint16)
    rgb = np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8)
    return [(index / 30.0, rgb, depth_mm) for index in range(2)]


def camera_receiver() -> Callable[[], tuple[float, float, np.ndarray, np.ndarray] | None]:
    """A driver with one image for every second call; an image comes with its time of arrival."""
    images = iter(camera_images())
    ready = iter([False, True] * len(camera_images()))
    return lambda: (time.monotonic(), *next(images)) if next(ready) else None


GIVEN: dict[str, Callable[[], Any]] = {"images": camera_images, "receive": camera_receiver}


@pytest.mark.parametrize("block", PYTHON_BLOCKS, ids=lambda block: block.place)
def test_python_blocks_run(block: Block, workspace: Path, monkeypatch):
    monkeypatch.chdir(workspace)
    names = {name: GIVEN[name]() for name in block.given}
    path, line = block.place.rsplit(":", 1)
    # Line numbers of a traceback are those of the page.
    code = compile("\n" * (int(line) - 1) + block.text, path, "exec")
    exec(code, {"__name__": "__main__", **names})


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: f"{c.place} {' '.join(c.words[:2])}")
def test_commands_parse(command: Command, workspace: Path, monkeypatch):
    monkeypatch.chdir(workspace)
    program, *words = command.words
    program = Path(program).name
    if program == "semsplat":
        # Settings of runs that only the documentation has.
        words = ["runs/demo/config.yaml" if w.endswith("/config.yaml") else w for w in words]
        parse_job(words, monkeypatch)
    elif program == "make":
        targets = {word for word in words if "=" not in word}
        assert targets <= make_targets()
    elif words[:1] == ["-m"]:
        parse_module(words[1], words[2:], monkeypatch)
    else:
        assert words[0] in ("setup.py", "-c") or (ROOT / words[0]).is_file()


def parse_job(words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
    words = [word for word in words if word != "--verbose"]
    if not words or words[0] in ("JOB", "--help", "--version"):
        return
    assert words[0] in JOBS, f"there is no job {words[0]}"
    if {"--help", "--help-all"} & set(words):
        return
    if words[0] in PROGRAMS:
        parse_arguments(PROGRAMS[words[0]], words[1:], words[0])
        return
    module = importlib.import_module(f"toolkit.tools.cli.{JOBS[words[0]][0]}")
    if hasattr(module, "parse_run"):
        monkeypatch.setattr(run_program, "parse_arguments", stop_after(parse_arguments))
    elif hasattr(module, "parse_arguments"):
        monkeypatch.setattr(module, "parse_arguments", stop_after(module.parse_arguments))
    else:
        stop_parsers(monkeypatch)
    with pytest.raises(ParsedError):
        module.main(words[1:])


def parse_module(name: str, words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
    if name in ("pytest", "pip", "venv"):
        return
    place = ROOT / name.replace(".", "/")
    program = place / "__main__.py" if place.is_dir() else place.with_suffix(".py")
    assert program.is_file(), f"no module {name}"
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setattr(sys, "argv", [name, *words])
    monkeypatch.setattr(tyro, "cli", stop_after(tyro.cli))
    stop_parsers(monkeypatch)
    with pytest.raises(ParsedError):
        runpy.run_module(name, run_name="__main__")


def stop_parsers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let programs that use argparse end after parsing."""
    parse = argparse.ArgumentParser.parse_known_args

    def parsed(parser: argparse.ArgumentParser, *args: Any, **options: Any) -> None:
        _, unknown = parse(parser, *args, **options)
        assert not unknown, f"unknown arguments {unknown}"
        raise ParsedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", parsed)


@functools.cache
def make_targets() -> set[str]:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    return set(re.findall(r"^([\w-]+):", makefile, flags=re.M))


@functools.cache
def known_options() -> set[str]:
    """All options of all jobs."""
    options = [option for job in JOBS for option in job_options(job)]
    common = {"--help", "--help-all", "--verbose", "--version"}
    return common.union(*(option_names(option) for option in options))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_options_jobs_and_files_in_the_text_exist(page: Path):
    known = known_options()
    created = {block.file for block in documentation.changes(page)}
    wrong = []
    for place, code in documentation.inline_codes(page):
        if code.startswith("--"):
            option = re.split(r"[ =|]", code)[0]
            group = option.removesuffix("*").removesuffix(".") + "."
            if option not in known and not any(o.startswith(group) for o in known):
                wrong.append(f"{place}: no job has the option {option}")
        elif code.startswith("semsplat ") and re.match(r"[a-z-]+$", code.split()[1]):
            if code.split()[1] not in JOBS:
                wrong.append(f"{place}: there is no job {code.split()[1]}")
        elif re.match(r"(toolkit|tests|apps|docs|data_tools|benchmarks)/[\w./*-]+$", code):
            if code not in created and not list(ROOT.glob(code.rstrip("/"))):
                wrong.append(f"{place}: {code} does not exist")
        elif re.match(r"toolkit(\.\w+)+$", code) and not exists(code):
            wrong.append(f"{place}: {code} does not exist")
    assert not wrong, "\n".join(wrong)


def exists(dotted: str) -> bool:
    """Whether a module, or an attribute of one, has this name."""
    try:
        importlib.import_module(dotted)
    except ModuleNotFoundError:
        parent, _, name = dotted.rpartition(".")
        return bool(parent) and exists(parent) and hasattr(sys.modules[parent], name)
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path):
    broken = []
    for place, target in documentation.links(page):
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        if path in GENERATED_PAGES:
            continue
        if not path.exists():
            broken.append(f"{place}: {target} does not exist")
        elif ROOT / "docs" in page.parents and ROOT / "docs" not in path.parents:
            broken.append(f"{place}: {target} is not part of the website; name the file instead")
        elif anchor and anchor not in documentation.anchors(path):
            broken.append(f"{place}: {file or page.name} has no heading #{anchor}")
    assert not broken, "\n".join(broken)


def test_the_reference_lists_every_option_with_a_description():
    rows = [line for line in options_page().splitlines() if line.startswith("| `--")]
    listed = {row.split("`")[1] for row in rows}
    assert {o for o in known_options() if not o.startswith("--no-")} >= listed
    assert {"--tracking.dense.max-width", "--dataset.path", "--min-confidence"} <= listed
    width = next(row for row in rows if "`--tracking.dense.max-width`" in row)
    assert "| `INT` >= 16 | `480` | Maximum image width for tracking" in width
    confidence = next(row for row in rows if "`--min-confidence`" in row)
    assert "| `FLOAT` [0, 1] | `0.0` | " in confidence


def test_the_reference_describes_every_public_name():
    page = api_page()
    for name in toolkit.__all__:
        assert f"### toolkit.{name}\n" in page


def test_the_page_of_rooms_has_every_package():
    page = rooms_page()
    packages = {path.parent.relative_to(ROOT / "toolkit") for path in ROOT.glob("toolkit/**/*.py")}
    for package in packages - {Path(".")}:
        assert re.search(f"^##+ {package.as_posix()}$", page, flags=re.M), package
    assert rooms()[0] == "tools" and rooms()[-1] == "base"
    assert "- **Knows**: `geometry`, `pose_graph`" in page


def test_docstrings_become_lists():
    text = (
        "Align.\n\nArgs:\n    a, b: images [H, W]\n        of one size.\n\nReturns:\n    the pose."
    )
    assert [line for line in markdown_docstring(text) if line] == [
        "Align.",
        "**Arguments**",
        "- `a, b`: images [H, W]",
        "  of one size.",
        "**Returns**",
        "- the pose.",
    ]


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = {
        ROOT / "docs" / page for page in re.findall(r": ([\w/-]+\.md)$", navigation, flags=re.M)
    }
    assert listed == GENERATED_PAGES | set((ROOT / "docs").rglob("*.md"))


def test_the_readme_is_short():
    assert documentation.word_count(ROOT / "README.md") <= 1150


def test_lines_of_the_readme_are_wrapped():
    wide = [place for place, line in documentation.prose(ROOT / "README.md") if len(line) > 100]
    assert not wide, f"wrap at 100 characters: {', '.join(wide)}"
