"""Lists the results that were measured with code that has changed since.

    python -m benchmarks.stale            print the list
    python -m benchmarks.stale --write    also update the index in benchmarks/RESULTS.md

A file of results is stale if a commit after its own has changed a path that its header names
under "measures". Not every such commit changes results; this can only be found by measuring again.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import tyro

from benchmarks.shared.repository import commits_since
from benchmarks.shared.results_file import RESULTS, Results, read_all
from benchmarks.shared.tables import Table

INDEX = RESULTS.parent / "RESULTS.md"

_COLUMNS = ("results", "targets met", "date", "commit", "later commits")
_PREAMBLE = """\
# Results

By subject; each file has the conditions in its header: commit, command, machine, instruction set,
threads and seeds. Times are comparable within a file, not between files. "Later commits" counts
those that changed the measured code between the measurement and the last update of this page;
`python -m benchmarks.stale` prints the current numbers. How to run the benchmarks is in
[README.md](README.md).
"""


def staleness(results: Results) -> str:
    """Number of later commits that changed the measured code, "unknown" outside its history."""
    count = commits_since(results.header.code.commit, results.header.measures)
    return "unknown" if count is None else str(count)


def subject(results: Results) -> str:
    """The folder of the benchmark, from the command `python -m benchmarks.SUBJECT.NAME`."""
    return results.header.command.split("benchmarks.")[1].split()[0].partition(".")[0]


def index_table(files: Sequence[Results], title: str) -> Table:
    """A row for each file of results."""
    rows = []
    for results in files:
        code = results.header.code
        commit = f"{code.commit or 'unknown'}{' (modified)' if code.modified else ''}"
        link = f"[{results.title}]({RESULTS.name}/{results.name}.md)"
        rows.append((link, _targets(results), results.header.date, commit, staleness(results)))
    return Table(_COLUMNS, tuple(rows), title)


def _targets(results: Results) -> str:
    verdicts = [
        row[-1] for table in results.tables if table.title == "Targets" for row in table.rows
    ]
    return f"{verdicts.count('met')} of {len(verdicts)}" if verdicts else ""


def update_index(path: Path = INDEX, folder: Path = RESULTS) -> None:
    """Write the index of all files of results."""
    by_subject: dict[str, list[Results]] = {}
    for results in read_all(folder):
        by_subject.setdefault(subject(results), []).append(results)
    tables = [index_table(files, name).markdown() for name, files in sorted(by_subject.items())]
    path.write_text("\n\n".join([_PREAMBLE.strip(), *tables]) + "\n", encoding="utf-8")


def main(write: bool = False) -> None:
    """Print the stale results.

    Args:
        write: update benchmarks/RESULTS.md.
    """
    files = read_all()
    stale = [(results, count) for results in files if (count := staleness(results)) != "0"]
    for results, count in stale:
        commit, date = results.header.code.commit, results.header.date
        print(f"{results.name}: measured on {date} at {commit}, later commits: {count}")
        print(f"    {results.header.command}")
    print(f"{len(stale)} of {len(files)} files of results are stale")
    if write:
        update_index()


if __name__ == "__main__":
    tyro.cli(main)
