"""compare: one page that shows what differs between runs."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from layout_run import changed, make_run
from test_finished_run_programs import one_line_of_error

from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, build_parts
from toolkit.runs.evaluation.comparison import direction
from toolkit.tools.cli.compare import unique_names
from toolkit.tools.cli.main import main


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
    links = set(re.findall(r'href="([^"#][^"]*)"', page))
    assert len(links) == 2
    assert all((tmp_path / unquote(link)).is_file() for link in links)
    assert page.count('<svg role="img"') == 1


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


@pytest.fixture(scope="module")
def two_rooms(tmp_path_factory, tiny_run) -> tuple[Path, Path]:
    """Runs of a room before and after a chair has moved and a ball has been removed."""
    folder, layout = tmp_path_factory.mktemp("two"), LAYOUTS["room"]()
    kept = ("wall", "floor", "bed", "chair", "exercise-ball")
    before = [part for part in build_parts(layout, 0) if part.class_name in kept]
    runs = [
        make_run(folder / name, layout, parts, spacing_m=0.04)
        for name, parts in (("before", before), ("after", changed(before)))
    ]
    for run in runs:
        shutil.copy(tiny_run / "metrics.json", run)
    return runs[0], runs[1]


def compared(runs, tmp_path, *words: str) -> dict:
    out = tmp_path / "changes.json"
    page = str(tmp_path / "page.html")
    assert main(["compare", *map(str, runs), "--out", page, "--objects", str(out), *words]) == 0
    return json.loads(out.read_text())


def test_objects_that_moved_or_are_gone_are_listed(two_rooms, tmp_path, capsys):
    content = compared(two_rooms, tmp_path, "--same-frame")
    found = {(c["change"], c["name"]): c for c in content["changes"]}
    assert set(found) == {("moved", "chair"), ("gone", "exercise-ball")}
    moved = found["moved", "chair"]
    assert moved["distance_m"] == pytest.approx(np.hypot(1.5, 0.6), abs=0.1)
    assert content["unchanged"] >= 1
    printed = capsys.readouterr().out
    assert "moved  chair  from (" in printed and "gone   exercise-ball  at (" in printed


def test_a_registration_aligns_the_maps_in_either_order(two_rooms, tmp_path):
    before, after = two_rooms
    identity = {"run_a": str(before), "run_b": str(after), "T_a_b": np.eye(4).tolist()}
    file = tmp_path / "register.json"
    file.write_text(json.dumps(identity))
    content = compared((after, before), tmp_path, "--registration", str(file))
    assert {(c["change"], c["name"]) for c in content["changes"]} == {
        ("moved", "chair"),
        ("new", "exercise-ball"),
    }


def test_wrong_comparisons_of_objects_are_reported_in_one_line(two_rooms, tmp_path, capsys):
    other = tmp_path / "register.json"
    other.write_text(json.dumps({"run_a": "a", "run_b": "b", "T_a_b": np.eye(4).tolist()}))
    damaged = tmp_path / "damaged.json"
    damaged.write_text("{}")
    out = str(tmp_path / "o.json")
    for words, said in (
        (["--same-frame"], "give it"),
        (["--objects", str(tmp_path / "o.txt")], ".json"),
        (["--objects", out, "--same-frame", "--registration", str(other)], "not both"),
        (["--objects", out, "--registration", str(other)], "belongs to a and b"),
        (["--objects", out, "--registration", str(damaged)], "is not a register.json"),
        (["--objects", out, "--registration", str(tmp_path / "no.json")], "cannot read"),
        (["--objects", out], "submaps are missing"),
    ):
        page = str(tmp_path / "p.html")
        assert said in one_line_of_error(capsys, "compare", *two_rooms, "--out", page, *words)
        assert not Path(page).exists(), "the page was written before the error"
    assert not Path(out).exists()
    three = [two_rooms[0], *two_rooms]
    line = one_line_of_error(capsys, "compare", *three, "--objects", out, "--same-frame")
    assert "compares two runs, got 3" in line
