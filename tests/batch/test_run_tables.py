"""The table of many runs."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from toolkit.runs.batch.plan import PlannedRun
from toolkit.runs.batch.report import write_batch_report
from toolkit.runs.batch.table import run_row, table_csv, table_markdown
from toolkit.runs.settings import RunSettings
from toolkit.tools.cli.run_many import running_text

GOOD = {"trajectory": {"ate_rmse_cm": 1.23456}, "images": {"mapped": {"psnr_db": None}}}


def run(folder: Path, name: str, metrics: dict | None = None) -> PlannedRun:
    out = folder / name
    out.mkdir()
    if metrics is not None:
        (out / "metrics.json").write_text(json.dumps(metrics))
    return PlannedRun(name, "default", 0, RunSettings(), out)


@pytest.fixture
def rows(tmp_path):
    return [
        run_row(run(tmp_path, "good", GOOD), "", 2),
        run_row(run(tmp_path, "bad"), "a | b is <missing>", 1),
        run_row(run(tmp_path, "lost"), "", 1),
    ]


def test_the_csv_has_every_metric_and_every_reason(rows):
    good, bad, lost = csv.DictReader(table_csv(rows).splitlines())
    ate = "trajectory.ate_rmse_cm"
    assert (good["state"], good["attempts"], good[ate]) == ("finished", "2", "1.23456")
    assert (bad["state"], bad["reason"], bad[ate]) == ("failed", "a | b is <missing>", "")
    assert lost["state"] == "failed" and "metrics.json cannot be read" in lost["reason"]


def test_markdown_escapes_and_leaves_out_what_no_run_has(rows):
    lines = table_markdown(rows).splitlines()
    assert lines[0] == "| sequence | settings | seed | state | trajectory.ate_rmse_cm |"
    assert lines[2] == "| good | default | 0 | finished | 1.235 |"
    assert lines[3] == "| bad | default | 0 | a \\| b is <missing> | n/a |"


def test_the_report_names_failures_and_links_finished_runs(rows, tmp_path):
    page = write_batch_report(tmp_path, "night", rows).read_text()
    assert "3 runs, 1 finished, 2 failed" in page
    assert "a | b is &lt;missing&gt;" in page
    assert 'href="good/report.html"' in page and "bad/report.html" not in page


def test_progress_names_three_running_runs():
    assert running_text({}) == "none"
    assert running_text({"a/x/seed0": 12}) == "a/x/seed0 frame 12"
    frames = {f"a/x/seed{n}": n for n in range(5)}
    expected = "a/x/seed0 frame 0, a/x/seed1 frame 1, a/x/seed2 frame 2, 2 more"
    assert running_text(frames) == expected
