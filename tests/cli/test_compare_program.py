"""compare: one page that shows what differs between runs."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest
from test_finished_run_programs import one_line_of_error

from toolkit.cli.compare import unique_names
from toolkit.cli.main import main
from toolkit.evaluation.comparison import direction


@pytest.fixture
def other_run(tiny_run, tmp_path) -> Path:
    """The tiny run with another seed and other metrics."""
    other = shutil.copytree(tiny_run, tmp_path / "other <run>")
    config = other / "config.yaml"
    config.write_text(re.sub(r"(?m)^seed: 0$", "seed: 7", config.read_text()))
    metrics = json.loads((other / "metrics.json").read_text())
    metrics["trajectory"]["ate_rmse_cm"] = 77.5
    metrics["images"]["mapped"]["psnr_db"] = 99.25
    metrics["images"]["conventions"]["ssim"] = "another window"
    metrics["semantics"]["mapped"]["miou_percent"] = None
    (other / "metrics.json").write_text(json.dumps(metrics))
    return other


def page_of(tmp_path, *runs: Path) -> str:
    out = tmp_path / "compare.html"
    assert main(["compare", *map(str, runs), "--out", str(out)]) == 0
    return out.read_text()


def row(page: str, key: str) -> list[tuple[str, str]]:
    """Class and text of the cells in the first row of a key."""
    (line,) = re.findall(rf"<tr><td>{re.escape(key)}</td>(.*?)</tr>", page)[:1]
    return re.findall(r'<td class="(\w*)">(.*?)</td>', line)


def test_the_page_marks_what_differs(tiny_run, other_run, tmp_path):
    page = page_of(tmp_path, tiny_run, other_run)
    assert row(page, "seed") == [("differs", "0"), ("differs", "7")]
    assert [css for css, _ in row(page, "images.mapped.psnr_db")] == ["worst", "best"]
    assert [css for css, _ in row(page, "trajectory.ate_rmse_cm")] == ["best", "worst"]
    assert row(page, "semantics.mapped.miou_percent")[1] == ("differs", "n/a")
    assert [css for css, _ in row(page, "frames.lost")] == ["", ""]
    assert row(page, "images.conventions.ssim")[1] == ("differs", "another window")
    assert "<td>max_frames</td>" not in page


def test_the_page_works_offline_and_escapes_names(tiny_run, other_run, tmp_path):
    page = page_of(tmp_path, tiny_run, other_run)
    assert "http" not in page and "<script" not in page
    sources = re.findall(r'src="([^"]{0,24})', page)
    # Every rendered view of both runs.
    assert len(sources) == 2 * len(list((tiny_run / "renders").glob("frame??????.png")))
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "other &lt;run&gt;" in page and "<run>" not in page
    # Drawings refer to their own markers.
    links = {link for link in re.findall(r'href="([^"]+)"', page) if not link.startswith("#")}
    assert len(links) == 2
    assert all((tmp_path / unquote(link)).is_file() for link in links)
    assert page.count("<svg") == 1


def test_names_are_as_long_as_they_must_be():
    assert unique_names([Path("/r/a"), Path("/r/b")]) == ["a", "b"]
    assert unique_names([Path("/x/run"), Path("/y/run")]) == ["x/run", "y/run"]
    assert unique_names([Path("/x/run"), Path("/x/run")]) == ["//x/run (1)", "//x/run (2)"]


@pytest.mark.parametrize(
    ("key", "better"),
    [
        ("trajectory.ate_rmse_cm", "low"),
        ("images.unseen.psnr_db", "high"),
        ("mesh.f_score_1cm_percent", "high"),
        ("mesh.completion_cm", "low"),
        ("memory.peak_mb", "low"),
        ("depth.mapped.l1_cm", "low"),
        ("depth.mapped.coverage_percent", None),
        ("frames.lost", "low"),
        ("time.tracking_ms_per_frame", "low"),
        ("images.mapped.ms_ssim", "high"),
        ("semantics.mapped.level_1.accuracy_percent", "high"),
        ("semantics.mapped.ece_percent", "low"),
        ("trajectory.ate_pairs", None),
        ("frames.total", None),
        ("images.mapped.views", None),
        ("images.conventions.psnr", None),
    ],
)
def test_the_better_direction_follows_from_the_name(key, better):
    assert direction(key) == better


def test_bad_comparisons_are_reported_in_one_line(tiny_run, other_run, tmp_path, capsys):
    out = ["--out", tmp_path / "a.html"]
    assert "at least two" in one_line_of_error(capsys, "compare", tiny_run, *out)
    line = one_line_of_error(capsys, "compare", tiny_run, other_run, "--out", tmp_path / "a.pdf")
    assert ".html" in line
    line = one_line_of_error(capsys, "compare", tiny_run, tmp_path / "nothing", *out)
    assert "contains no run" in line
    (other_run / "metrics.json").unlink()
    assert "--resume" in one_line_of_error(capsys, "compare", tiny_run, other_run, *out)
