"""The table of many runs: one row per run, as CSV, Markdown and HTML."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from toolkit.base.errors import FormatError
from toolkit.runs.batch.plan import PlannedRun
from toolkit.runs.evaluation.metrics import flattened, read_metrics

# Metrics in Markdown and HTML; the CSV file has all of them.
SHOWN = (
    "trajectory.ate_rmse_cm",
    "images.mapped.psnr_db",
    "images.unseen.psnr_db",
    "depth.mapped.l1_cm",
    "semantics.mapped.miou_percent",
    "frames.total",
    "frames.lost",
    "frames.doubtful",
    "frames.in_other_parts",
    "time.total_ms_per_frame",
    "memory.peak_mb",
)


@dataclass(frozen=True)
class RunRow:
    """One run in the table.

    Attributes:
        run: the run.
        state: "finished" or "failed".
        reason: why it failed; empty if it finished.
        attempts: how often its process was started.
        metrics: content of metrics.json by dotted key; empty if it failed.
    """

    run: PlannedRun
    state: str
    reason: str
    attempts: int
    metrics: dict[str, Any]


def run_row(run: PlannedRun, reason: str, attempts: int) -> RunRow:
    """Return the row of a run that has ended.

    Args:
        reason: why it failed; empty if it finished.
        attempts: how often its process was started.
    """
    metrics: dict[str, Any] = {}
    if not reason:
        try:
            metrics = flattened(read_metrics(run.folder / "metrics.json"))
        except FormatError as error:
            reason = str(error)
    return RunRow(run, "failed" if reason else "finished", reason, attempts, metrics)


def table_csv(rows: Sequence[RunRow]) -> str:
    """Return the table with all metrics as CSV; the header names units."""
    metrics = sorted({key for row in rows for key in row.metrics})
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow((*_PLACE, "state", "attempts", *metrics, "reason"))
    for row in rows:
        values = [row.metrics.get(key) for key in metrics]
        writer.writerow((*_place(row), row.state, row.attempts, *values, row.reason))
    return stream.getvalue()


def table_cells(rows: Sequence[RunRow]) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of the table for readers; metrics without a value are left out."""
    shown = [key for key in SHOWN if any(row.metrics.get(key) is not None for row in rows)]
    titles = [*_PLACE, "state", *shown]
    return titles, [
        [*_place(row), row.reason or row.state, *(_cell(row.metrics.get(key)) for key in shown)]
        for row in rows
    ]


def table_markdown(rows: Sequence[RunRow]) -> str:
    """Return the table as Markdown."""
    titles, cells = table_cells(rows)
    lines = [titles, ["---"] * len(titles), *cells]
    return "".join("| " + " | ".join(map(_escaped, line)) + " |\n" for line in lines)


_PLACE = ("sequence", "settings", "seed")


def _place(row: RunRow) -> tuple[str, str, str]:
    return (row.run.sequence, row.run.settings_name, str(row.run.seed))


def _cell(value: Any) -> str:
    if value is None:
        return "n/a"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
