"""Read the documentation: Python blocks, shell commands, inline code and links of its pages."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = ("semsplat", "make", "python", ".venv/bin/python", ".venv/bin/semsplat")

_FENCE = re.compile(r"^( *)```(\w*)\s*$")
_LONE_LINK = re.compile(r"^\s*(?:- )?!?\[[^\]]*\]\([^)]*\)\S?$")
# Names that the test must define before it executes the block that follows.
_GIVEN = re.compile(r"^<!-- given: ([\w, ]+) -->$")
# The file of the checkout that the block that follows creates or, as a diff, changes.
_FILE = re.compile(r"^<!-- file: (\S+) -->$")
# Elements of a synopsis, such as "..." and "[--option]".
_PLACEHOLDER = re.compile(r"^(\.\.\.|\[.*\])$")


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        place: page and line number of its first line.
        language: of the fence; empty for an indented block.
        text: the code.
        given: names that it expects to be defined.
        file: that it creates or changes; empty for none.
    """

    place: str
    language: str
    text: str
    given: tuple[str, ...] = ()
    file: str = ""


@dataclass(frozen=True)
class Command:
    """A shell command.

    Attributes:
        place: page and line number.
        words: program and arguments, without placeholders and comments.
    """

    place: str
    words: tuple[str, ...]


def blocks(page: Path) -> Iterator[Block]:
    """The fenced and indented blocks of a page, in order."""
    lines = page.read_text(encoding="utf-8").splitlines()
    name = page.relative_to(ROOT)
    given: tuple[str, ...] = ()
    file, number = "", 0
    while number < len(lines):
        line = lines[number]
        fence, hint, place = _FENCE.match(line), _GIVEN.match(line), _FILE.match(line)
        start = number + 1
        if fence:
            end = next(i for i in range(start, len(lines)) if _FENCE.match(lines[i]))
            text = "\n".join(text.removeprefix(fence[1]) for text in lines[start:end])
            yield Block(f"{name}:{start + 1}", fence[2], text, given, file)
            number = end
        elif line.startswith("    ") and (number == 0 or not lines[number - 1].strip()):
            end = number
            while end < len(lines) and (lines[end].startswith("    ") or not lines[end].strip()):
                end += 1
            yield Block(f"{name}:{start}", "", "\n".join(t[4:] for t in lines[number:end]))
            number = end - 1
        if fence or (line.strip() and not hint and not place):
            given, file = (), ""
        if hint:
            given = tuple(word.strip() for word in hint[1].split(","))
        if place:
            file = place[1]
        number += 1


def changes(page: Path) -> list[Block]:
    """The blocks of a page that create or change a file."""
    return [block for block in blocks(page) if block.file]


def commands(page: Path) -> Iterator[Command]:
    """The shell commands of a page that call our own programs."""
    for block in blocks(page):
        if block.language not in ("", "sh", "bash", "console"):
            continue
        path, line = block.place.rsplit(":", 1)
        for offset, text in _logical_lines(block.text):
            for part in re.split(r" && ", text.removeprefix("$ ")):
                words = _words(part)
                if words and words[0] in PROGRAMS:
                    yield Command(f"{path}:{int(line) + offset}", words)


def inline_codes(page: Path) -> Iterator[tuple[str, str]]:
    """Inline code of a page, each with its place; blocks are left out."""
    in_fence = False
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        if _FENCE.match(line):
            in_fence = not in_fence
        elif not in_fence:
            for code in re.findall(r"`([^`]+)`", line):
                yield f"{page.relative_to(ROOT)}:{number}", code


def links(page: Path) -> Iterator[tuple[str, str]]:
    """Targets of the links and pictures of a page that are not on the web."""
    text = page.read_text(encoding="utf-8")
    for number, line in enumerate(text.splitlines(), start=1):
        for target in re.findall(r"\]\(([^)\s]+)\)", line):
            if not re.match(r"[a-z]+:", target):
                yield f"{page.relative_to(ROOT)}:{number}", target


def prose(page: Path) -> Iterator[tuple[str, str]]:
    """Lines of a page, each with its place, that can be wrapped.

    Code blocks, tables, and lines with nothing but a link or a picture are left out.
    """
    in_fence = False
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        if _FENCE.match(line):
            in_fence = not in_fence
        elif not in_fence and not line.startswith("|") and not _LONE_LINK.match(line):
            yield f"{page.relative_to(ROOT)}:{number}", line


def word_count(page: Path) -> int:
    """Number of words that a reader of the rendered page sees, code and tables included."""
    text = page.read_text(encoding="utf-8")
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return len(re.findall(r"\w\S*", text))


def anchors(page: Path) -> set[str]:
    """The anchors of the headings of a page, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ +(.+?) *$", page.read_text(encoding="utf-8"), flags=re.M)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with their offsets; a backslash at the end continues a line."""
    lines = text.splitlines()
    number = 0
    while number < len(lines):
        start, line = number, lines[number]
        while line.endswith("\\") and number + 1 < len(lines):
            number += 1
            line = line[:-1] + " " + lines[number].strip()
        yield start, line
        number += 1


def _words(line: str) -> tuple[str, ...]:
    try:
        words = shlex.split(line, comments=True)
    except ValueError:  # prose or output, not a command
        return ()
    while words and re.match(r"^[A-Z_]+=", words[0]):
        del words[0]  # variables of the environment
    return tuple(word for word in words if not _PLACEHOLDER.match(word))
