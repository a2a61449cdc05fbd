"""The numbered examples of the public API in apps/, executed on tiny data."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

APPS = Path(__file__).resolve().parents[2] / "apps"


@pytest.fixture
def execute(monkeypatch, capsys):
    """Runs an example as a script and returns what it printed; checks that it succeeds."""

    def run(name: str, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(APPS / name), run_name="__main__")
        printed = capsys.readouterr()
        assert end.value.code == 0, printed.err
        return printed.out

    return run


def test_run(execute, tiny_recording, tiny_run, tmp_path):
    assert "6 poses" in execute("01_run.py", "folder", tiny_recording, tmp_path / "out")
    written = (tmp_path / "out" / "trajectory.txt").read_bytes()
    assert written == (tiny_run / "trajectory.txt").read_bytes()
    assert (tmp_path / "out" / "map.ply").is_file()


def test_camera_loop(execute, tmp_path):
    printed = execute("02_camera_loop.py", tmp_path / "map.ply", 3, 64, 48)
    assert "frame 2: camera at" in printed
    assert (tmp_path / "map.ply").is_file() and (tmp_path / "map.txt").is_file()


def test_render(execute, tiny_run, tmp_path):
    execute("03_render.py", tiny_run, tmp_path / "views", 2)
    names = sorted(path.name for path in (tmp_path / "views").iterdir())
    assert names == ["colour_00.png", "colour_01.png", "depth_00.png", "depth_01.png"]


def test_evaluate(execute, tiny_run):
    printed = execute("04_evaluate.py", tiny_run)
    assert "ate_rmse_cm" in printed and "largest position error" in printed


def test_a_missing_run_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["03_render.py", str(tmp_path), str(tmp_path / "out")])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(APPS / "03_render.py"), run_name="__main__")
    assert end.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
