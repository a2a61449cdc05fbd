"""Many runs and refinement on a Ray cluster of this machine."""

from __future__ import annotations

import csv
import json
import os
import signal
import time
from pathlib import Path

import pytest
from programs import MAIN, semsplat, start
from tiny_plans import write_plan

pytest.importorskip("ray", reason="ray is not installed (pip install 'semsplat[cluster]')")

SAME = ("trajectory.txt", "map.ply", "loops.jsonl")


def test_a_lost_worker_costs_one_resumed_run(night, rooms, tmp_path):
    resources = {"threads": 1, "memory_gb": 0.5}
    plan = write_plan(tmp_path / "r.yaml", rooms, "a", "missing", resources=resources)
    program = start("-m", MAIN, "run-many", plan, "--ray.cpus", 2)
    attempts = tmp_path / "r/logs/a/quick/seed0.attempts.jsonl"
    deadline = time.monotonic() + 120
    while not list((tmp_path / "r/a/quick/seed0").glob("checkpoint/[01]/metadata.json")):
        assert time.monotonic() < deadline and program.poll() is None
        time.sleep(0.02)
    os.kill(json.loads(attempts.read_text())["worker_pid"], signal.SIGKILL)
    _, errors = program.communicate(timeout=240)
    assert program.returncode == 1, errors  # one sequence is missing
    rows = list(csv.DictReader((tmp_path / "r/table.csv").open()))
    assert [(row["state"], row["attempts"]) for row in rows] == [
        ("finished", "2"),
        ("failed", "1"),
    ]
    assert [json.loads(line)["resumed"] for line in attempts.open()] == [False, True]
    for name in SAME:
        whole, other = (out / "a/quick/seed0" / name for out in (night.out, tmp_path / "r"))
        assert whole.read_bytes() == other.read_bytes(), name


def test_refinement_on_two_workers_is_that_in_one_process(submaps_run: Path, tmp_path):
    for name, words in (("one", ()), ("two", ("--ray.cpus", 2, "--memory-gb", 0.5))):
        done = semsplat("refine", submaps_run, "--out", tmp_path / name, *words)
        assert done.returncode == 0, done.stderr
    files = [p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*") if p.is_file()]
    assert len(files) > 6
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_a_missing_cluster_is_one_line(submaps_run: Path, tmp_path):
    words = ("--out", tmp_path / "out", "--ray.address", "127.0.0.1:1")
    done = semsplat("refine", submaps_run, *words)
    assert done.returncode == 2
    assert "there is no cluster" in done.stderr.strip().splitlines()[-1]
