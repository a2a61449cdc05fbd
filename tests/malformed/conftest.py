"""A place with a copy of a dataset and of a finished run, which a test may damage."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from folder_content import content_of

from toolkit.tools.cli.main import main


@pytest.fixture
def place(tiny_recording: Path, tiny_run: Path, resumable_run: Path, tmp_path: Path) -> Path:
    """A folder with `data`, `run`, `killed` with checkpoints, and `other`, which stays whole."""
    shutil.copytree(tiny_recording, tmp_path / "data")
    shutil.copytree(tiny_run, tmp_path / "run")
    shutil.copytree(resumable_run, tmp_path / "killed")
    (tmp_path / "other").symlink_to(tiny_run)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("not to be lost")
    names = ["bed", "chair", "table"]
    (tmp_path / "names.txt").write_text("\n".join(names))
    (tmp_path / "settings.yaml").write_text("seed: 1\n")
    shutil.copy(tiny_run / "config.yaml", tmp_path / "whole.yaml")
    (tmp_path / "replica").mkdir()
    (tmp_path / "replica" / "traj.txt").write_text(json.dumps(names))
    return tmp_path


@pytest.fixture
def refused(place: Path, monkeypatch, capfd) -> Callable[..., str]:
    """Runs the command in `place`; checks that it fails as it must and returns its message."""

    def run(*words: str) -> str:
        monkeypatch.chdir(place)
        before = content_of(place)
        capfd.readouterr()
        assert main(list(words)) == 2
        printed = capfd.readouterr().err
        lines = printed.splitlines()
        assert len(lines) == 1, printed
        assert lines[0].startswith("semsplat: error: "), printed
        assert content_of(place) == before, "files were changed, lost or left behind"
        return lines[0].removeprefix("semsplat: error: ")

    return run
