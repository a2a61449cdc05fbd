"""The report of many runs: a table with links, and pages that compare the runs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import jinja2

from toolkit.base.errors import ToolkitError
from toolkit.io.atomic import write_text
from toolkit.runs.batch.table import RunRow, table_cells, table_csv, table_markdown
from toolkit.runs.evaluation.comparison import render_comparison
from toolkit.runs.maps.comparing import compared_run

_log = logging.getLogger(__name__)

# Maximum number of runs on one comparison page, which contains their images.
MAX_COMPARED = 12


def write_batch_report(out: Path, title: str, rows: Sequence[RunRow]) -> Path:
    """Write table.csv, table.md, the comparison pages and report.html; return the report's path.

    Args:
        out: folder of the runs.
        title: name of the plan.
        rows: of all runs.
    """
    write_text(out / "table.csv", table_csv(rows))
    write_text(out / "table.md", table_markdown(rows))
    pages = _write_comparisons(out, rows)
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = resources.files(__package__).joinpath("report_template.html").read_text("utf-8")
    titles, cells = table_cells(rows)
    links = [
        (row.run.folder / "report.html").relative_to(out).as_posix() if not row.reason else None
        for row in rows
    ]
    failed = sum(bool(row.reason) for row in rows)
    text = environment.from_string(template).render(
        title=title,
        count=len(rows),
        failed=failed,
        titles=titles,
        rows=list(zip(cells, links, strict=True)),
        pages=pages,
    )
    report = out / "report.html"
    write_text(report, text)
    return report


def _write_comparisons(out: Path, rows: Sequence[RunRow]) -> list[str]:
    """Write one comparison of all runs, or one per sequence if there are many."""
    finished = [row for row in rows if not row.reason]
    groups = {"all": finished}
    if len(finished) > MAX_COMPARED:
        groups = {}
        for row in finished:
            groups.setdefault(row.run.sequence, []).append(row)
    pages = []
    for name, group in groups.items():
        if len(group) < 2:
            continue
        if len(group) > MAX_COMPARED:
            _log.info("The comparison of %s shows the first %d runs.", name, MAX_COMPARED)
        page = out / f"compare-{name}.html"
        try:
            runs = [
                compared_run(row.run.folder, row.run.name, page) for row in group[:MAX_COMPARED]
            ]
        except ToolkitError as error:
            _log.warning("There is no comparison of %s: %s.", name, error)
            continue
        write_text(page, render_comparison(runs))
        pages.append(page.name)
    return pages
