"""`semsplat run --pace`: frames arrive faster than they are processed; all of them are scored."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest
from killed_runs import kept_checkpoints
from programs import semsplat
from tiny_recording import FRAMES

from toolkit.runs.maps.finished import load_run
from toolkit.tools.cli.main import main

# The frames arrive within 6 ms, in which no machine processes them all.
OPTIONS = ("--pace", "1000", "--pacing.max-delay-s", "0.001")


@pytest.fixture(scope="module")
def paced_run(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("paced") / "run"
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording), *OPTIONS]
    done = semsplat("run", *words, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def read_json(path: Path):
    return json.loads(path.read_text(encoding="utf-8"))


def test_dropped_frames_are_counted_marked_and_logged(paced_run: Path):
    metrics = read_json(paced_run / "metrics.json")
    frames = read_json(paced_run / "frames.json")
    assert metrics["pace"]["frames_dropped"] == len(frames["dropped"]) > 0
    assert metrics["frames"]["lost"] == 0
    assert metrics["pace"]["delay_max_ms"] >= metrics["pace"]["delay_median_ms"] > 1.0
    assert metrics["pace"]["mapping_steps_skipped"] > 0
    log = (paced_run / "log.txt").read_text(encoding="utf-8")
    assert "depend on the speed of this machine" in log
    assert f"Dropped {metrics['pace']['frames_dropped']} of {FRAMES} frames" in log


def test_all_frames_are_scored_and_dropped_ones_have_the_pose_before(paced_run: Path):
    run = load_run(paced_run)
    assert [frame.index for frame in run.tracked] == list(range(FRAMES))
    for index in read_json(paced_run / "frames.json")["dropped"]:
        before, dropped = run.tracked[index - 1], run.tracked[index]
        assert dropped.T_map_camera.tolist() == before.T_map_camera.tolist()
    metrics = read_json(paced_run / "metrics.json")
    assert metrics["frames"]["total"] == metrics["trajectory"]["ate_pairs"] == FRAMES
    assert metrics["images"]["mapped"]["views"] == FRAMES


def test_delays_are_a_file_and_a_chart(paced_run: Path):
    with (paced_run / "delays.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    dropped = [int(row["frame"]) for row in rows if row["outcome"] == "dropped"]
    assert [int(row["frame"]) for row in rows] == list(range(FRAMES))
    assert dropped == read_json(paced_run / "frames.json")["dropped"]
    report = (paced_run / "report.html").read_text(encoding="utf-8")
    assert "Delay over time" in report
    assert f"{len(dropped)} frames were dropped" in report


def test_evaluating_again_keeps_the_delays(paced_run: Path):
    before = read_json(paced_run / "metrics.json")
    assert main(["evaluate", str(paced_run)]) == 0
    after = read_json(paced_run / "metrics.json")
    assert after["pace"] == before["pace"]
    assert after["trajectory"]["ate_pairs"] == before["trajectory"]["ate_pairs"]


def test_other_runs_have_no_delays(tiny_run: Path):
    assert "pace" not in read_json(tiny_run / "metrics.json")
    assert "dropped" not in read_json(tiny_run / "frames.json")
    assert not (tiny_run / "delays.csv").exists()
    assert "Delay over time" not in (tiny_run / "report.html").read_text(encoding="utf-8")


def test_a_pace_of_zero_is_no_pace(tiny_run: Path, tiny_recording: Path, tmp_path: Path):
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording), "--pace", "0"]
    assert main(["run", *words, "--out", str(tmp_path / "run")]) == 0
    for name in ("trajectory.txt", "map.ply", "loops.jsonl", "config.yaml"):
        assert (tmp_path / "run" / name).read_bytes() == (tiny_run / name).read_bytes(), name


def test_a_resumed_run_keeps_its_record(tiny_recording: Path, tmp_path: Path):
    """The last checkpoint is that after the last frame."""
    out = tmp_path / "run"
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording), *OPTIONS]
    with kept_checkpoints():
        assert main(["run", *words, "--out", str(out)]) == 0
    before = read_json(out / "metrics.json")
    (out / "metrics.json").unlink()
    shutil.rmtree(out / "renders")
    words = ["run", "--config", str(out / "config.yaml"), "--out", str(out), "--resume"]
    assert main(words) == 0
    after = read_json(out / "metrics.json")
    assert after["pace"] == before["pace"]


def test_mapping_with_given_poses_is_paced(tiny_recording: Path, tmp_path: Path):
    words = ["--dataset.kind", "folder", "--dataset.path", str(tiny_recording), *OPTIONS]
    assert main(["run", *words, "--poses", "given", "--out", str(tmp_path / "run")]) == 0
    metrics = read_json(tmp_path / "run" / "metrics.json")
    assert metrics["frames"]["total"] == FRAMES
    assert metrics["pace"]["fps"] == 1000.0
