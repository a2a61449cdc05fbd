"""Tasks that lose their worker or run out of memory, on a stand-in for Ray and on Ray itself."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from toolkit.base.errors import ToolkitError
from toolkit.runs.batch.options import RayOptions
from toolkit.runs.batch.plan import Resources
from toolkit.runs.batch.process import RunJob, execute_run
from toolkit.runs.batch.ray_cluster import (
    OnRay,
    ProcessKilledError,
    RayCluster,
    TaskResources,
    ray_cluster,
)
from toolkit.tools.cli.main import main


class OutOfMemoryError(Exception):
    pass


class WorkerCrashedError(Exception):
    pass


class NodeDiedError(Exception):
    pass


class RayTaskError(Exception):
    def __init__(self, cause: Exception) -> None:
        self.cause = cause


class FakeRay:
    """Executes tasks in the order in which they were sent, one by one."""

    exceptions = SimpleNamespace(
        OutOfMemoryError=OutOfMemoryError,
        WorkerCrashedError=WorkerCrashedError,
        NodeDiedError=NodeDiedError,
        RayTaskError=RayTaskError,
    )

    def __init__(self) -> None:
        self.started: list[Any] = []
        self.options: dict[str, Any] = {}

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": {"CPU": 2.0, "memory": 8e9}}]

    def remote(self, **options: Any) -> Callable:
        self.options = options
        return lambda function: SimpleNamespace(remote=lambda item: Sent(function, item))

    def wait(self, sent: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        return sent[:num_returns], sent[num_returns:]

    def get(self, sent: Any) -> Any:
        self.started.append(sent.item)
        try:
            return sent.function(sent.item)
        except (OutOfMemoryError, WorkerCrashedError, NodeDiedError):
            raise
        except Exception as error:
            raise RayTaskError(error) from error


class Sent:
    def __init__(self, function: Callable, item: Any) -> None:
        self.function, self.item = function, item


class Failing:
    """Returns its item; "bad" fails the first times."""

    def __init__(self, error: Exception, times: int) -> None:
        self._error, self._left = error, times

    def __call__(self, item: str) -> str:
        if item == "bad" and self._left:
            self._left -= 1
            raise self._error
        return item


LOSSES = {
    "out of memory": OutOfMemoryError(),
    "worker was lost": WorkerCrashedError(),
    "worker was lost ": NodeDiedError(),
    "process was killed": ProcessKilledError(),
}


@pytest.mark.parametrize("words", LOSSES)
def test_a_lost_task_is_repeated_a_stated_number_of_times(words):
    ray = FakeRay()
    tasks = RayCluster(ray).unordered(
        Failing(LOSSES[words], 2), ["bad", "good"], TaskResources(retries=2)
    )
    assert {task.index: task.value for task in tasks} == {0: "bad", 1: "good"}
    assert ray.started.count("bad") == 3
    assert ray.options["max_retries"] == 0, "the repetitions are ours, not Ray's"


@pytest.mark.parametrize("words", LOSSES)
def test_then_it_fails_with_the_reason_while_the_others_finish(words):
    tasks = RayCluster(FakeRay()).unordered(
        Failing(LOSSES[words], 99), ["good", "bad", "fine"], TaskResources(memory_gb=1.5, retries=2)
    )
    results = {task.index: task for task in tasks}
    assert [results[i].value for i in range(3)] == ["good", None, "fine"]
    assert words.strip() in results[1].failure and "3 times" in results[1].failure
    assert ("1.5 GB were declared" in results[1].failure) == ("worker was lost" not in words)


def test_a_task_without_memory_waits_for_another_one_to_end():
    ray = FakeRay()
    items = ["bad", "a", "b"]
    list(RayCluster(ray).unordered(Failing(OutOfMemoryError(), 1), items, TaskResources()))
    assert ray.started == ["bad", "a", "b", "bad"]


@pytest.mark.parametrize(
    ("resources", "message"),
    [
        (TaskResources(cores=3), "a task needs 3 cores, but the largest node of the cluster has 2"),
        (TaskResources(memory_gb=9.0), r"a task needs 9 GB, but .* has 8.0 GB"),
    ],
)
def test_tasks_that_no_node_can_execute_are_refused(resources, message):
    ray = FakeRay()
    with pytest.raises(ToolkitError, match=message):
        RayCluster(ray).map(Failing(OutOfMemoryError(), 0), ["good"], resources)
    assert ray.started == []


def test_a_program_says_that_its_tasks_do_not_fit(tiny_run, tmp_path, monkeypatch, capsys):
    cluster = nullcontext(RayCluster(FakeRay()))
    monkeypatch.setattr("toolkit.runs.batch.ray_cluster.ray_cluster", lambda _: cluster)
    words = ["--out", str(tmp_path / "out"), "--ray.cpus", "2", "--threads", "3"]
    assert main(["refine", str(tiny_run), *words]) == 2
    assert "a task needs 3 cores" in capsys.readouterr().err.strip().splitlines()[-1]


def test_a_map_needs_every_task():
    with pytest.raises(ToolkitError, match=r"task 0 on the cluster failed: .*out of memory, 2 tim"):
        RayCluster(FakeRay()).map(
            Failing(OutOfMemoryError(), 9), ["bad", "good"], TaskResources(retries=1)
        )


def test_a_run_without_memory_is_named_while_the_others_finish(tmp_path, monkeypatch):
    """Through the executor of plans: the outcome has the name of the run and the reason."""
    jobs = [RunJob(n, tmp_path / n, "", tmp_path / "logs", 1) for n in ("small", "huge")]

    def executed(job: RunJob, worker: str = "") -> SimpleNamespace:
        if job.name == "huge":
            raise OutOfMemoryError
        return SimpleNamespace(name=job.name, reason="", time_s=1.0, killed=False)

    monkeypatch.setattr("toolkit.runs.batch.ray_cluster.execute_run", executed)
    ray = FakeRay()
    executor = OnRay(RayCluster(ray), Resources(threads=1, memory_gb=2.0, retries=1))
    outcomes = {outcome.name: outcome.reason for outcome in executor.execute(jobs)}
    assert outcomes["small"] == ""
    assert "ran out of memory, 2 times; 2 GB were declared" in outcomes["huge"]
    assert len(ray.started) == 3


def test_a_run_that_the_kernel_kills_is_recognised(tmp_path, monkeypatch):
    """The kernel ends the process with the largest memory: that of the run, not its worker."""
    program = f"import os, signal; os.kill(os.getpid(), {int(signal.SIGKILL)})"
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\nexec {os.sys.executable} -c '{program}'\n")
    python.chmod(0o755)
    monkeypatch.setattr("toolkit.runs.batch.process.sys.executable", str(python))
    job = RunJob("a/b/seed0", tmp_path / "out/a/b/seed0", "", tmp_path / "logs", 1)
    outcome = execute_run(job)
    assert outcome.killed and "probably for lack of memory" in outcome.reason


def slow(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def test_the_memory_monitor_of_ray(monkeypatch, tmp_path: Path):
    """Ray takes all memory for used, and kills each worker that it finds."""
    pytest.importorskip("ray", reason="ray is not installed (pip install 'semsplat[cluster]')")
    monkeypatch.setenv("RAY_memory_usage_threshold", "0.0001")
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "50")
    resources = TaskResources(memory_gb=0.1, retries=1)
    with ray_cluster(RayOptions(cpus=1)) as cluster:
        (result,) = cluster.unordered(slow, [60.0], resources)
    assert "ran out of memory, 2 times; 0.1 GB were declared" in result.failure
