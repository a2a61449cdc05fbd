"""Programs that write a run folder end at once if another process is running in it."""

import shutil

import pytest
from test_finished_run_programs import one_line_of_error

from toolkit.runs.lock import locked


@pytest.fixture
def copy(labelled_run, tmp_path):
    return shutil.copytree(labelled_run, tmp_path / "copy")


def contents(folder) -> dict:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_nothing_is_written_into_a_folder_in_use(copy, tmp_path, capsys):
    before, new = contents(copy), tmp_path / "new"
    new.mkdir()
    resume = ["run", "--config", copy / "config.yaml", "--out", copy, "--resume"]
    calls = {
        copy: [resume],
        new: [["refine", copy, "--out", new], ["edit", copy, "--out", new, "--remove", "wall"]],
    }
    for held, programs in calls.items():
        with locked(held):
            for words in programs:
                line = one_line_of_error(capsys, *words)
                assert f"another process is running in {held}" in line
    assert contents(copy) == before
    assert new.is_dir() and not list(new.iterdir())
