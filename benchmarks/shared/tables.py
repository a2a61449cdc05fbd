"""Tables of medians and of targets, as Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

MISSING = "n/a"

Metrics = dict[str, Any]
Rows = Mapping[str, Sequence[Metrics]]


@dataclass(frozen=True)
class Table:
    """A table of text; the first column names the rows.

    Attributes:
        columns: titles of all columns, the first one included.
        rows: cells of all columns.
        title: heading above the table; none if empty.
        note: paragraph below the table.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    title: str = ""
    note: str = ""

    def cell(self, row: str, column: str) -> str:
        """One cell by the names of its row and column.

        Raises:
            KeyError: there is no such row or column.
        """
        for cells in self.rows:
            if cells[0] == row:
                return dict(zip(self.columns, cells, strict=True))[column]
        raise KeyError(row)

    def markdown(self) -> str:
        """The table as Markdown, its title and note included."""
        lines = [f"## {self.title}", ""] if self.title else []
        lines += [table_line(self.columns), "|---" * len(self.columns) + "|"]
        lines += [table_line(row) for row in self.rows]
        return "\n".join([*lines, *(["", self.note] if self.note else [])])


def table_of(columns: Sequence[str], rows: Rows, first_column: str = "", title: str = "") -> Table:
    """A table of medians: each row has the metrics of one or more runs."""
    cells = [
        (name, *(median_cell([run.get(column) for run in runs]) for column in columns))
        for name, runs in rows.items()
    ]
    return Table((first_column, *columns), tuple(cells), title)


def worst_table(
    worst: Mapping[str, Callable[[Sequence[Any]], Any]],
    rows: Rows,
    first_column: str = "",
    title: str = "",
) -> Table:
    """A table of the worst runs: `worst` chooses among the values of each column, as min or max."""
    chosen = {
        name: [{column: worst_of(runs, column, choose) for column, choose in worst.items()}]
        for name, runs in rows.items()
    }
    return table_of(tuple(worst), chosen, first_column, title)


def worst_of(
    runs: Sequence[Metrics], column: str, choose: Callable[[Sequence[Any]], Any]
) -> Any | None:
    """What `choose` selects from a column; None if a value is missing."""
    values = [run.get(column) for run in runs]
    return None if not values or any(value is None for value in values) else choose(values)


def median_cell(values: Sequence[Any]) -> str:
    """The median of numbers as text, n/a if one is missing; text that all agree on as it is."""
    if not values or any(value is None for value in values):
        return MISSING
    if any(isinstance(value, str) for value in values):
        return " / ".join(dict.fromkeys(str(value) for value in values))
    median = statistics.median(values)
    if median == int(median) and all(isinstance(value, int) for value in values):
        return str(int(median))
    return f"{median:.0f}" if abs(median) >= 1000 else f"{median:.4g}"


@dataclass(frozen=True)
class Target:
    """A value that a metric should reach.

    Attributes:
        label: what is measured, with its unit.
        value: the measured one; None where it is not available.
        at_most, at_least: the bound; exactly one is given.
    """

    label: str
    value: float | None
    at_most: float | None = None
    at_least: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the value is within the bound; None without a value."""
        if self.value is None:
            return None
        if self.at_most is not None:
            return self.value <= self.at_most
        assert self.at_least is not None
        return self.value >= self.at_least


def target_table(targets: Sequence[Target]) -> Table:
    """Each target beside what was measured; misses stand out."""
    verdicts = {True: "met", False: "**missed**", None: "not measured"}
    rows = []
    for target in targets:
        if target.at_most is not None:
            bound = f"at most {target.at_most:g}"
        else:
            bound = f"at least {target.at_least:g}"
        measured = median_cell([target.value])
        rows.append((target.label, bound, measured, verdicts[target.met]))
    return Table(("metric", "target", "measured", "result"), tuple(rows), "Targets")


def median_of(rows: Rows) -> Callable[..., float | None]:
    """A function (row, column) to the median over runs; None where a value is missing."""

    def median(row: str, column: str) -> float | None:
        runs = rows.get(row, [])
        values = [float(run[column]) for run in runs if run.get(column) is not None]
        return statistics.median(values) if values and len(values) == len(runs) else None

    return median


# What is measured with its unit, row, column, and what it should be at most or at least.
Bound = tuple[str, str, str, float]


def targets_of(
    rows: Rows, *, at_most: Sequence[Bound] = (), at_least: Sequence[Bound] = ()
) -> list[Target]:
    """Targets for the medians of cells."""
    median = median_of(rows)
    return [
        *(Target(what, median(row, column), at_most=value) for what, row, column, value in at_most),
        *(Target(what, median(row, column), at_least=val) for what, row, column, val in at_least),
    ]


def table_line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
