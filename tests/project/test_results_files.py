"""Files of benchmark results, README's figures made of them, and what is stale."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import readme_figures, stale
from benchmarks.accuracy.compare_open3d import TITLES
from benchmarks.shared import repository, runner
from benchmarks.shared.repository import CodeVersion, commits_since
from benchmarks.shared.results_file import RESULTS, Header, Results, read_all, read_results
from benchmarks.shared.runner import Options, Page, Report, ReportOptions, RunStore
from benchmarks.shared.tables import Table, Target, median_cell, table_of, target_table, targets_of

HEADER = Header(
    date="2026-01-02",
    code=CodeVersion("0123456789", "2026-01-01", modified=True),
    command="python -m benchmarks.accuracy.sequences --only 'a | b'",
    machine="a CPU, 2 cores; load 0.1",
    instruction_set="avx2",
    threads="2",
    seeds=(0, 1),
    measures=("toolkit", "-toolkit/tools/cli"),
)
TABLES = (
    Table(("row", "a | b"), (("x", "1.5"), ("y", "n/a")), note="A note."),
    Table(("metric", "value"), (("z", "**missed**"),), "Targets"),
)


def test_a_file_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    results = Results("name", "Title", "One.\n\nTwo.", HEADER, TABLES, "Observed.")
    assert read_results(results.write(tmp_path)) == results
    unknown = replace(results, header=replace(HEADER, code=CodeVersion("", ""), seeds=()))
    assert read_results(unknown.write(tmp_path)).header.code.commit == ""
    assert results.table().cell("x", "a | b") == "1.5"
    assert results.table("Targets").cell("z", "value") == "**missed**"
    with pytest.raises(KeyError):
        results.table().cell("z", "a | b")


def test_files_without_a_header_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bare.md").write_text("# Title\n\n| a |\n|---|\n| 1 |\n")
    with pytest.raises(ValueError, match=r"bare\.md has no header table"):
        read_results(tmp_path / "bare.md")
    text = (
        Results("cut", "Title", "Text.", HEADER, TABLES).markdown().replace("| threads | 2 |\n", "")
    )
    (tmp_path / "cut.md").write_text(text)
    with pytest.raises(ValueError, match="the header lacks 'threads'"):
        read_results(tmp_path / "cut.md")


def test_cells_are_medians_and_missing_values_show() -> None:
    table = table_of(("a", "b"), {"row": [{"a": 1.0, "b": 3}, {"a": 9.0}, {"a": 2.0, "b": 5}]})
    assert table.rows == (("row", "2", "n/a"),)
    assert median_cell([123456.0]) == "123456"
    assert median_cell([0.123456, 0.2, 0.1]) == "0.1235"
    assert median_cell(["1, 2", "1, 2"]) == "1, 2"


def test_misses_stand_out() -> None:
    table = target_table(
        [
            Target("low", 1.5, at_most=1.0),
            Target("high", 99.0, at_least=97.0),
            Target("unknown", None, at_least=1.0),
        ]
    )
    assert [row[1:] for row in table.rows] == [
        ("at most 1", "1.5", "**missed**"),
        ("at least 97", "99", "met"),
        ("at least 1", "n/a", "not measured"),
    ]


@pytest.fixture
def history(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Commits of a small repository: toolkit/a.py, then toolkit/cli/b.py, then toolkit/a.py."""

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    git("init", "-q")
    commits = []
    for number, name in enumerate(("toolkit/a.py", "toolkit/tools/cli/b.py", "toolkit/a.py")):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(number))
        git("add", ".")
        git("commit", "-q", "-m", str(number))
        commits.append(git("rev-parse", "HEAD"))
    monkeypatch.setattr(repository, "ROOT", tmp_path)
    return commits


def test_commits_after_a_measurement_are_counted_by_path(history: list[str]) -> None:
    first, second, last = history
    assert commits_since(first, ["toolkit"]) == 2
    assert commits_since(first, ["toolkit", "-toolkit/tools/cli"]) == 1
    assert commits_since(second, ["toolkit/tools/cli"]) == 0
    assert commits_since(last, ["toolkit"]) == 0
    assert commits_since("f" * 40, ["toolkit"]) is None
    assert commits_since("", ["toolkit"]) is None


def test_uncommitted_changes_are_noted(history: list[str]) -> None:
    version = repository.code_version()
    assert history[-1].startswith(version.commit)
    assert not version.modified
    (repository.ROOT / "toolkit/new.py").write_text("")
    assert repository.code_version().modified


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What stands for the hash of the sources; runs are stored in a temporary folder."""
    versions = {"digest": "one"}
    monkeypatch.setattr(runner, "WORK", tmp_path / "work")
    monkeypatch.setattr(runner, "source_digest", lambda: versions["digest"])
    return versions


def measured(options: ReportOptions, calls: list[tuple[str, int]]) -> None:
    """A benchmark of two rows and two seeds."""

    def measure(job: str, seed: int) -> dict[str, float]:
        calls.append((job, seed))
        return {"value": 10.0 * len(job) + seed}

    benchmark = Report("tiny", "Tiny", "Text.", options, (0, 1))
    rows = benchmark.measured({"first": "a", "second": "bb"}, measure)
    benchmark.write(table_of(("value",), rows))


def test_a_benchmark_continues_where_it_stopped(code: dict[str, str], tmp_path: Path) -> None:
    calls: list[tuple[str, int]] = []
    measured(ReportOptions(out=tmp_path, only=("second",)), calls)
    assert calls == [("bb", 0), ("bb", 1)]
    assert not (tmp_path / "tiny.md").exists()
    # An interrupted call may leave half a line.
    with (tmp_path / "work/tiny.jsonl").open("a") as file:
        file.write('{"key": [')
    measured(ReportOptions(out=tmp_path), calls)
    assert calls[2:] == [("a", 0), ("a", 1)]
    table = read_results(tmp_path / "tiny.md").table()
    assert table.rows == (("first", "10.5"), ("second", "20.5"))
    # Other code, or a request for it, measures again.
    measured(ReportOptions(out=tmp_path, fresh=True, only=("first",)), calls)
    assert len(calls) == 6
    code["digest"] = "two"
    measured(ReportOptions(out=tmp_path), calls)
    assert len(calls) == 10


def test_an_unknown_row_is_refused(code: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no row 'third'; rows: first, second"):
        measured(ReportOptions(out=tmp_path, only=("third",)), [])


def test_a_page_has_medians_and_targets(code: dict[str, str], tmp_path: Path) -> None:
    def measure(job: list[str], seed: int) -> dict[str, float]:
        return {"value": 10.0 * len(job) + seed}

    page = Page(
        "tiny",
        "Tiny",
        "Text.",
        {"first": ["a"], "second": ["b", "c"]},
        measure,
        lambda rows: [table_of(("value",), rows)],
        lambda rows: targets_of(rows, at_least=[("value of first", "first", "value", 11.0)]),
        seeds=3,
    )
    page.write(Options(out=tmp_path, seeds=3))
    results = read_results(tmp_path / "tiny.md")
    assert results.table().rows == (("first", "11"), ("second", "21"))
    assert results.table("Targets").cell("value of first", "result") == "met"


def test_runs_of_other_machines_are_not_found(
    code: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "store.jsonl"
    RunStore(path).add(["job", 0], {"value": 1})
    assert RunStore(path).find(["job", 0]) == {"value": 1}
    monkeypatch.setattr(runner, "machine_identity", lambda: "another CPU")
    assert RunStore(path).find(["job", 0]) is None


def test_readme_has_the_figures_of_the_results_files() -> None:
    text = readme_figures.README.read_text(encoding="utf-8")
    expected = readme_figures.filled(text, readme_figures.readme_figures())
    assert text == expected, "run: python -m benchmarks.readme_figures"


def test_readme_figures_follow_the_files(tmp_path: Path) -> None:
    for results in read_all():
        results.write(tmp_path)
    path = tmp_path / "registration-redkitchen.md"
    path.write_text(re.sub(r"\| 0 \| met \|", "| 3 | **missed** |", path.read_text()))
    figures = readme_figures.readme_figures(tmp_path)
    assert "- registration-redkitchen: SGR, wrong but verified: 3, at most 0" in figures
    assert "3/18 (17 %)" not in readme_figures.readme_figures()
    text = f"before\n{readme_figures.BEGIN}\nold\n{readme_figures.END}\nafter\n"
    filled = readme_figures.filled(text, figures)
    assert "old" not in filled
    assert filled.startswith("before\n") and filled.endswith("after\n")
    with pytest.raises(ValueError, match="lacks"):
        readme_figures.filled("no markers", figures)


def test_readme_quotes_the_most_accurate_setting_of_open3d(tmp_path: Path) -> None:
    for results in read_all():
        results.write(tmp_path)
    path = tmp_path / "open3d-office0.md"
    rows = {"dense-slam": "9.00", "dense-slam-tuned": "3.00", "odometry": "n/a"}
    text = path.read_text(encoding="utf-8")
    for name, ate in rows.items():
        text = re.sub(rf"(\| {re.escape(TITLES[name])} \|) [^|]+ \|", rf"\1 {ate} |", text)
    path.write_text(
        re.sub(rf"\| {re.escape(TITLES['odometry-planes'])} \|.*\n", "", text), encoding="utf-8"
    )
    figures = " ".join(readme_figures.readme_figures(tmp_path).split())
    assert re.search(
        r"office0 3\.00 cm, \d+ ms with dense SLAM, 30/20/10 iterations \(semsplat", figures
    )


def test_the_index_lists_every_file(tmp_path: Path) -> None:
    stale.update_index(tmp_path / "RESULTS.md")

    def rows(path: Path) -> list[list[str]]:
        lines = path.read_text(encoding="utf-8").splitlines()
        # The last column grows with every commit.
        return [line.split(" | ")[:-1] for line in lines if line.startswith("| [")]

    assert rows(stale.INDEX) == rows(tmp_path / "RESULTS.md"), (
        "run: python -m benchmarks.stale --write"
    )
    assert len(rows(stale.INDEX)) == len(list(RESULTS.glob("*.md")))
