"""`semsplat run-many` as a process: one sequence after the other."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import time

import pytest
from programs import MAIN, run, semsplat, start
from tiny_plans import write_plan

SAME = ("trajectory.txt", "map.ply", "loops.jsonl")


def test_one_failing_sequence_does_not_stop_the_others(night, rooms):
    assert night.done.returncode == 1, night.done.stderr
    rows = list(csv.DictReader((night.out / "table.csv").open()))
    assert [row["state"] for row in rows] == ["finished", "failed", "finished"]
    assert rows[1]["reason"] == f"{rooms / 'missing'} does not exist; check the path"
    assert f"failed: missing/quick/seed0: {rows[1]['reason']}" in night.done.stderr
    assert "[3/3] b/quick/seed0: finished" in night.done.stderr
    assert float(rows[0]["frames.total"]) == 8
    assert (night.out / "report.html").is_file() and (night.out / "compare-all.html").is_file()


def test_finished_runs_are_skipped(night):
    maps = [night.out / n / "quick/seed0/map.ply" for n in "ab"]
    before = [path.stat().st_mtime_ns for path in maps]
    again = semsplat("run-many", night.plan)
    assert again.returncode == 1 and "1 to execute" in again.stdout
    assert [path.stat().st_mtime_ns for path in maps] == before
    listed = semsplat("run-many", night.plan, "--dry-run")
    assert listed.returncode == 0 and "2 finished, 1 new" in listed.stdout


def test_a_killed_program_takes_its_run_with_it_and_resumes_it(night, rooms, tmp_path):
    plan = write_plan(tmp_path / "killed.yaml", rooms, "a")
    assert "1 new" in semsplat("run-many", plan, "--dry-run").stdout
    assert not (tmp_path / "killed").exists()
    silent = {"stderr": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    program = start("-m", MAIN, "run-many", plan, **silent)
    folder = tmp_path / "killed/a/quick/seed0"
    deadline = time.monotonic() + 120
    while not list(folder.glob("checkpoint/[01]/metadata.json")):
        assert time.monotonic() < deadline and program.poll() is None
        time.sleep(0.02)
    os.kill(program.pid, signal.SIGKILL)
    program.wait()
    attempts = tmp_path / "killed/logs/a/quick/seed0.attempts.jsonl"
    pid = json.loads(attempts.read_text())["run_pid"]
    while is_running(pid):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert not (folder / "report.html").exists()
    assert "unfinished, frame" in semsplat("run-many", plan, "--dry-run").stdout

    assert semsplat("run-many", plan).returncode == 0
    assert [json.loads(line)["resumed"] for line in attempts.open()] == [False, True]
    for name in SAME:
        expected = (night.out / "a/quick/seed0" / name).read_bytes()
        assert (folder / name).read_bytes() == expected


def is_running(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nothing.yaml",), "cannot read the plan nothing.yaml"),
        ((), "Missing"),
        (("p.yaml", "--ray.cpus", "0"), "--ray.cpus"),
    ],
)
def test_bad_input_is_one_line(tmp_path, words, message):
    done = semsplat("run-many", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and message in done.stderr


def test_without_ray_a_cluster_is_one_line(rooms, tmp_path):
    plan = write_plan(tmp_path / "p.yaml", rooms, "a")
    block = "import sys; sys.modules['ray'] = None; from toolkit.tools.cli.main import main; "
    code = block + f"sys.exit(main(['run-many', {str(plan)!r}, '--cluster']))"
    done = run("-c", code)
    assert done.returncode == 2
    assert "pip install 'semsplat[cluster]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
