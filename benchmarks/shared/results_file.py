"""Files of results: one Markdown file per benchmark, with what was measured in its header."""

from __future__ import annotations

import datetime
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.shared.machine import describe_machine, instruction_set
from benchmarks.shared.repository import SYSTEM, CodeVersion, code_version
from benchmarks.shared.tables import Table, table_line

RESULTS = Path(__file__).parents[1] / "results"

_FIELDS = (
    *("date", "commit", "command", "machine", "instruction set", "threads", "seeds", "measures"),
)
_MODIFIED = "with uncommitted changes"


@dataclass(frozen=True)
class Header:
    """The conditions of a measurement.

    Attributes:
        date: of the measurement, YYYY-MM-DD.
        code: the version of the code.
        command: as typed, from the repository root.
        machine: processor, cores, load, memory and versions in one line.
        instruction_set: of the native kernels.
        threads: of each process, as text: the number or a range.
        seeds: of all random choices; empty where there are none.
        measures: paths of the code that the results depend on; a leading "-" excludes one.
    """

    date: str
    code: CodeVersion
    command: str
    machine: str
    instruction_set: str
    threads: str
    seeds: tuple[int, ...] = ()
    measures: tuple[str, ...] = SYSTEM


@dataclass(frozen=True)
class Results:
    """The content of one file of results.

    Attributes:
        name: of the file, without its suffix.
        title: heading of the file.
        description: what is measured and how the data are made; paragraphs of Markdown.
        header: the conditions.
        tables: the first one is the main one.
        notes: observations on these very numbers; lost when they are measured again.
    """

    name: str
    title: str
    description: str
    header: Header
    tables: tuple[Table, ...] = field(default=())
    notes: str = ""

    def table(self, title: str = "") -> Table:
        """The table of that title; the first one by default.

        Raises:
            KeyError: there is no such table.
        """
        for table in self.tables:
            if title in ("", table.title):
                return table
        raise KeyError(title)

    def markdown(self) -> str:
        """The whole file."""
        notes = [f"## Notes\n\n{self.notes}"] if self.notes else []
        tables = [table.markdown() for table in self.tables]
        parts = [f"# {self.title}", self.description, _header_table(self.header), *tables, *notes]
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> Path:
        """Write NAME.md into a folder and return its path."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.md"
        path.write_text(self.markdown(), encoding="utf-8")
        return path


def read_results(path: Path) -> Results:
    """Read a file that `Results.write` wrote.

    Raises:
        ValueError: the header is incomplete or a table is malformed.
    """
    text, _, notes = path.read_text(encoding="utf-8").partition("\n## Notes\n")
    title, _, body = text.partition("\n")
    blocks = [block.strip("\n") for block in body.split("\n\n") if block.strip()]
    first = next((i for i, block in enumerate(blocks) if block.startswith("| measured |")), None)
    if first is None:
        raise ValueError(f"{path} has no header table, which begins with '| measured |'")
    return Results(
        path.stem,
        title.removeprefix("# "),
        "\n\n".join(blocks[:first]),
        _parsed_header(blocks[first], path),
        _parsed_tables(blocks[first + 1 :], path),
        notes.strip(),
    )


def read_all(folder: Path = RESULTS) -> list[Results]:
    """All files of results in a folder, by name."""
    return [read_results(path) for path in sorted(folder.glob("*.md"))]


def current_header(
    seeds: Sequence[int] = (), measures: Sequence[str] = SYSTEM, threads: str = ""
) -> Header:
    """The conditions of a measurement that runs now, in this process and its children."""
    return Header(
        date=datetime.date.today().isoformat(),
        code=code_version(),
        command=_command(),
        machine=describe_machine(),
        instruction_set=instruction_set(),
        threads=threads or _threads(),
        seeds=tuple(seeds),
        measures=tuple(measures),
    )


def _header_table(header: Header) -> str:
    code = f"{header.code.commit or 'unknown'} of {header.code.date or 'unknown'}"
    values = {
        "date": header.date,
        "commit": f"{code}, {_MODIFIED}" if header.code.modified else code,
        "command": f"`{header.command}`",
        "machine": header.machine,
        "instruction set": header.instruction_set,
        "threads": header.threads,
        "seeds": ", ".join(map(str, header.seeds)) or "none",
        "measures": ", ".join(header.measures),
    }
    rows = [table_line((name, values[name])) for name in _FIELDS]
    return "\n".join(["| measured | |", "|---|---|", *rows])


def _parsed_header(block: str, path: Path) -> Header:
    rows = [_cells(line) for line in block.splitlines()[2:]]
    values = {name: value for name, value, *_ in rows}
    missing = [name for name in _FIELDS if name not in values]
    if missing:
        raise ValueError(f"{path}: the header lacks '{missing[0]}'")
    commit, _, rest = values["commit"].partition(" of ")
    date, _, changes = rest.partition(", ")
    seeds = values["seeds"]
    return Header(
        date=values["date"],
        code=CodeVersion("" if commit == "unknown" else commit, date, changes == _MODIFIED),
        command=values["command"].strip("`"),
        machine=values["machine"],
        instruction_set=values["instruction set"],
        threads=values["threads"],
        seeds=() if seeds == "none" else tuple(int(seed) for seed in seeds.split(",")),
        measures=tuple(values["measures"].split(", ")),
    )


def _parsed_tables(blocks: Sequence[str], path: Path) -> tuple[Table, ...]:
    tables: list[Table] = []
    title, note = "", ""
    for block in blocks:
        if block.startswith("## "):
            title = block.removeprefix("## ")
        elif block.startswith("|"):
            columns, _, *rows = block.splitlines()
            cells = tuple(_cells(row) for row in rows)
            if any(len(row) != len(_cells(columns)) for row in cells):
                raise ValueError(f"{path}: rows of table '{title}' differ in length")
            tables.append(Table(_cells(columns), cells, title))
            title = ""
        elif tables:
            note = "\n\n".join(filter(None, [tables[-1].note, block]))
            tables[-1] = Table(tables[-1].columns, tables[-1].rows, tables[-1].title, note)
    return tuple(tables)


def _cells(line: str) -> tuple[str, ...]:
    inner = line.strip().removeprefix("|").removesuffix("|").replace("\\|", "\0")
    return tuple(cell.strip().replace("\0", "|") for cell in inner.split("|"))


def _command() -> str:
    """The command of this process; absolute paths are reduced to their last part."""
    main = sys.modules["__main__"]
    module = main.__spec__.name if main.__spec__ else Path(sys.argv[0]).name
    arguments = [Path(word).name if os.path.isabs(word) else word for word in sys.argv[1:]]
    return f"python -m {module} {shlex.join(arguments)}".strip()


def _threads() -> str:
    import torch

    return str(torch.get_num_threads())
