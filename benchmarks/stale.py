"""Lists the results that were measured with code that has changed since.

    python -m benchmarks.stale            print the list
    python -m benchmarks.stale --write    also update the index in benchmarks/RESULTS.md

A file of results is stale if a commit after its own has changed a path that its header names
under "measures". Not every such commit changes results; this can only be found by measuring again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.repository import commits_since
from benchmarks.results_file import RESULTS, Results, read_all
from benchmarks.tables import Table

INDEX = RESULTS.parent / "RESULTS.md"

_COLUMNS = ("results", "date", "commit", "later commits")
_PREAMBLE = """\
# Results

One file for each benchmark, with the conditions in its header: commit, command, machine,
instruction set, threads and seeds. Times are comparable within a file, not between files.
"Later commits" counts those that changed the measured code between the measurement and the last
update of this page; `python -m benchmarks.stale` prints the current numbers. How to run the
benchmarks is in [README.md](README.md).
"""


def staleness(results: Results) -> str:
    """Number of later commits that changed the measured code, "unknown" outside its history."""
    count = commits_since(results.header.code.commit, results.header.measures)
    return "unknown" if count is None else str(count)


def index_table(files: Sequence[Results]) -> Table:
    """A row for each file of results."""
    rows = []
    for results in files:
        code = results.header.code
        commit = f"{code.commit or 'unknown'}{' (modified)' if code.modified else ''}"
        link = f"[{results.title}]({RESULTS.name}/{results.name}.md)"
        rows.append((link, results.header.date, commit, staleness(results)))
    return Table(_COLUMNS, tuple(rows))


def update_index(path: Path = INDEX, folder: Path = RESULTS) -> None:
    """Write the index of all files of results."""
    path.write_text(f"{_PREAMBLE}\n{index_table(read_all(folder)).markdown()}\n", encoding="utf-8")


def main() -> None:
    """Print the stale results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    arguments = parser.parse_args()
    stale = 0
    for results in read_all():
        count = staleness(results)
        if count != "0":
            stale += 1
            commit, date = results.header.code.commit, results.header.date
            print(f"{results.name}: measured on {date} at {commit}, later commits: {count}")
            print(f"    {results.header.command}")
    print(f"{stale} of {len(read_all())} files of results are stale")
    if arguments.write:
        update_index()


if __name__ == "__main__":
    main()
