"""Recordings for Rerun: what they contain, read back with the program of the package."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from tiny_recording import FRAMES

from toolkit.cli.main import main
from toolkit.errors import SettingsError

WORDS = ["--mapping.first-iterations", "4", "--mapping.final-iterations", "1"]


def run_words(recording: Path, out: Path, *more: str) -> list[str]:
    place = ["--dataset.kind", "folder", "--dataset.path", str(recording)]
    return ["run", *place, *WORDS, "--out", str(out), *more]


@pytest.fixture(scope="module")
def recorded(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    folder = tmp_path_factory.mktemp("recorded")
    record = folder / "run.rrd"
    interval = ["--mapping.keyframes.interval", "2"]
    words = run_words(tiny_recording, folder / "run", *interval, "--record", str(record))
    assert main(words) == 0
    return record


def rerun_program(*words: str) -> str:
    program = Path(sys.executable).parent / "rerun"
    environment = {**os.environ, "NO_COLOR": "1"}
    done = subprocess.run(
        [program, "rrd", *words], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def rows_by_entity(record: Path) -> Counter[str]:
    """Number of rows of each entity."""
    rows: Counter[str] = Counter()
    for line in rerun_program("print", str(record)).splitlines():
        found = re.search(r"with (\d+) rows .* - (/\S+) -", line)
        if found:
            rows[found[2]] += int(found[1])
    return rows


def test_the_file_is_valid(recorded: Path):
    rerun_program("verify", str(recorded))


def test_every_frame_has_images_a_pose_and_times(recorded: Path):
    rows = rows_by_entity(recorded)
    assert rows["/world/camera/colour"] == rows["/world/camera/depth"] == FRAMES
    # The intrinsics are one more, static row.
    assert rows["/world/camera"] == FRAMES + 1
    assert rows["/times/frame_ms"] == FRAMES
    assert rows["/times/tracking_ms"] == FRAMES - 1


def test_keyframes_have_the_map_and_the_path(recorded: Path):
    rows = rows_by_entity(recorded)
    keyframes = rows["/counts/keyframes"]
    assert 2 <= keyframes < FRAMES
    assert rows["/counts/gaussians"] == keyframes
    assert rows["/world/path"] == keyframes + 1  # and the final one
    assert rows["/world/map/0"] == 1
    assert rows["/world/submaps/0"] >= 2
    assert rows["/world/loops"] == 1


def test_rows_are_on_the_timelines_of_frames_and_seconds(recorded: Path):
    stats = rerun_program("stats", str(recorded))
    assert re.search(r"^frame: \d+$", stats, re.MULTILINE)
    assert re.search(r"^time: \d+$", stats, re.MULTILINE)


def test_recording_does_not_change_the_run(recorded: Path, tiny_recording: Path, tmp_path: Path):
    interval = ["--mapping.keyframes.interval", "2"]
    assert main(run_words(tiny_recording, tmp_path / "run", *interval)) == 0
    for name in ("trajectory.txt", "map.ply"):
        plain, own = tmp_path / "run" / name, recorded.parent / "run" / name
        assert plain.read_bytes() == own.read_bytes()


def test_a_missing_package_is_reported_before_the_run(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    words = run_words(Path("nowhere"), tmp_path / "run", "--record", str(tmp_path / "a.rrd"))
    assert main(words) == 2
    assert "pip install 'semsplat[recording]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_bad_names_are_reported_before_the_run(tmp_path: Path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    from toolkit.recording.rerun_recorder import RerunRecorder

    existing = tmp_path / "old.rrd"
    existing.write_bytes(b"precious")
    for path, message in (
        (tmp_path / "run.txt", "suffix .rrd"),
        (existing, "already exists"),
        (tmp_path / "none" / "run.rrd", "not a folder"),
    ):
        with pytest.raises(SettingsError, match=message):
            RerunRecorder(path)
    assert existing.read_bytes() == b"precious"
