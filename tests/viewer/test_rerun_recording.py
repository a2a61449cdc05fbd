"""Recordings for Rerun: what they contain, read back with the reader of the package."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_recording import FRAMES

from toolkit.base.errors import SettingsError
from toolkit.datasets.registry import open_dataset
from toolkit.runs.maps.finished import load_run
from toolkit.tools.cli.main import main

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


def batches(record: Path) -> dict[str, list[Any]]:
    """Arrow batches of each entity, in order."""
    from rerun.chunk import RrdReader

    found: dict[str, list[Any]] = defaultdict(list)
    for chunk in RrdReader(str(record)).stream():
        found[str(chunk.entity_path)].append(chunk.to_record_batch())
    return found


def column(record: Path, entity: str, name: str) -> list[Any]:
    """The values of a component of an entity, in order of the frames."""
    rows = [
        (frame, value)
        for batch in batches(record)[entity]
        if name in batch.schema.names
        for frame, value in zip(
            batch.column("frame").to_pylist(), batch.column(name).to_pylist(), strict=True
        )
        if value is not None
    ]
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def rows_by_entity(record: Path) -> Counter[str]:
    """Number of rows of each entity."""
    rows: Counter[str] = Counter()
    for entity, found in batches(record).items():
        rows[entity] = sum(batch.num_rows for batch in found)
    return rows


def test_the_file_is_valid(recorded: Path):
    program = Path(sys.executable).parent / "rerun"
    words = [program, "rrd", "verify", str(recorded)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


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


def test_images_are_those_of_the_frames(recorded: Path, tiny_recording: Path):
    frame = open_dataset("folder", tiny_recording)[3]
    (colour,) = column(recorded, "/world/camera/colour", "EncodedImage:blob")[3]
    decoded = cv2.imdecode(np.array(colour, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255.0
    assert np.abs(decoded - frame.rgb).mean() < 0.02
    (depth,) = column(recorded, "/world/camera/depth", "EncodedDepthImage:blob")[3]
    decoded = cv2.imdecode(np.array(depth, np.uint8), cv2.IMREAD_UNCHANGED) / 1000.0
    np.testing.assert_allclose(decoded, frame.depth_m, atol=6e-4)


def test_the_last_path_is_the_trajectory_of_the_run(recorded: Path):
    positions_m = column(recorded, "/world/path", "LineStrips3D:strips")[-1][0]
    expected = load_run(recorded.parent / "run").trajectory.positions_m
    np.testing.assert_allclose(positions_m, expected, atol=1e-6)


def test_rows_have_the_index_and_the_time_of_their_frame(recorded: Path):
    (batch, *_) = batches(recorded)["/times/frame_ms"]
    frames, times = batch.column("frame").to_pylist(), batch.column("time").to_pylist()
    assert times[-1].total_seconds() == pytest.approx(frames[-1] / 30.0, abs=1e-6)


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
    from toolkit.tools.viewer.rerun_recorder import RerunRecorder

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
