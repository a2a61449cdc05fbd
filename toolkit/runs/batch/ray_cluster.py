"""Start or join a Ray cluster, and execute functions and plans on it; the only import of ray."""

from __future__ import annotations

import importlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from toolkit.base.errors import DependencyError, SettingsError, ToolkitError
from toolkit.runs.batch.options import RayOptions
from toolkit.runs.batch.plan import Resources
from toolkit.runs.batch.process import RunJob, RunOutcome, execute_run

Item = TypeVar("Item")
Value = TypeVar("Value")

_log = logging.getLogger(__name__)

# Maximum time until a node of an existing cluster answers, seconds.
_PATIENCE_S = 10.0

_LOCALHOST = "127.0.0.1"
# Ray replaces the address of localhost by that of the network, unless it may not form clusters of
# several nodes on this machine.
_LOCAL_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
# Ray does not start with less.
_MIN_OBJECT_STORE_MB = 80

_VARIABLES = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # Workers print warnings about accelerators otherwise.
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS": "0",
}


# Why a task did not end.
LOST_WORKER = "its worker was lost"
OUT_OF_MEMORY = "its worker ran out of memory"
KILLED_PROCESS = "its process was killed, probably for lack of memory"


class ProcessKilledError(Exception):
    """Raised by a function whose own process was killed: the task is repeated like a lost one."""


@dataclass(frozen=True)
class TaskResources:
    """What the scheduler reserves for each task.

    Attributes:
        cores: number of cores, which is also the number of threads.
        memory_gb: memory in GB.
        retries: how often a task is repeated after its worker was lost or ran out of memory.
    """

    cores: int = 1
    memory_gb: float = 1.0
    retries: int = 3


@dataclass(frozen=True)
class TaskResult(Generic[Value]):
    """The result of one task.

    Attributes:
        index: position of its item.
        value: what the function returned; None if the task failed.
        failure: why it failed; empty if it did not.
    """

    index: int
    value: Value | None
    failure: str = ""


@dataclass(frozen=True)
class _Ended:
    """How a task ended: with a value, or with a loss after which it can be repeated."""

    index: int
    value: Any
    loss: str = ""

    def result(self, times: int, resources: TaskResources) -> TaskResult[Any]:
        """The final result after a number of losses."""
        if not self.loss:
            return TaskResult(self.index, self.value)
        reason = f"{self.loss}, {times} time{'s' if times > 1 else ''}"
        if self.loss != LOST_WORKER:
            reason += (
                f"; {resources.memory_gb:g} GB were declared, declare more so that fewer tasks run "
                "side by side, or use smaller images or submaps"
            )
        return TaskResult(self.index, None, reason)


class RayCluster:
    """A cluster that tasks can be sent to; created by `ray_cluster`."""

    def __init__(self, ray: Any) -> None:
        self._ray = ray

    def unordered(
        self, function: Callable[[Item], Value], items: Sequence[Item], resources: TaskResources
    ) -> Iterator[TaskResult[Value]]:
        """Call a function for each item, and yield the results as tasks end.

        A task whose worker is lost is repeated at once; one that ran out of memory is repeated when
        another task has ended. Functions and items are sent to the workers, and should be small.

        Raises:
            ToolkitError: no node of the cluster has the resources for a task.
            Exception: those that the function raises, except for `ProcessKilledError`.
        """
        self._check(resources)
        # Ray itself would repeat tasks that ran out of memory at once, and by default for ever.
        task = self._ray.remote(
            num_cpus=resources.cores, memory=int(resources.memory_gb * 1e9), max_retries=0
        )(function)
        running = {task.remote(item): index for index, item in enumerate(items)}
        postponed: list[int] = []
        losses = [0] * len(items)
        try:
            while running or postponed:
                if running:
                    ended = self._next(running)
                    losses[ended.index] += bool(ended.loss)
                    if ended.loss and losses[ended.index] <= resources.retries:
                        again = (ended.index, losses[ended.index], resources.retries)
                        _log.warning("Task %d is repeated (%d of %d): %s.", *again, ended.loss)
                        if ended.loss == LOST_WORKER:
                            running[task.remote(items[ended.index])] = ended.index
                        else:
                            postponed.append(ended.index)
                        continue
                    yield ended.result(losses[ended.index], resources)
                running |= {task.remote(items[index]): index for index in postponed}
                postponed = []
        finally:
            for pending in running:  # of a caller that gave up
                self._ray.cancel(pending, force=True)

    def _next(self, running: dict[Any, int]) -> _Ended:
        """Wait until a task ends, and remove it from those that run."""
        exceptions = self._ray.exceptions
        (ready,), _ = self._ray.wait(list(running), num_returns=1)
        index = running.pop(ready)
        try:
            return _Ended(index, self._ray.get(ready))
        except exceptions.OutOfMemoryError:
            return _Ended(index, None, OUT_OF_MEMORY)
        except (exceptions.WorkerCrashedError, exceptions.NodeDiedError):
            return _Ended(index, None, LOST_WORKER)
        except exceptions.RayTaskError as error:
            if isinstance(error.cause, ProcessKilledError):
                return _Ended(index, None, KILLED_PROCESS)
            raise error.cause if isinstance(error.cause, Exception) else error from None

    def map(
        self, function: Callable[[Item], Value], items: Sequence[Item], resources: TaskResources
    ) -> list[Value]:
        """Call a function for each item; results are in the order of the items.

        Raises:
            ToolkitError: a task has failed after all retries.
        """
        values: dict[int, Value] = {}
        for result in self.unordered(function, items, resources):
            if result.failure or result.value is None:
                raise ToolkitError(f"task {result.index} on the cluster failed: {result.failure}")
            values[result.index] = result.value
        return [values[index] for index in range(len(items))]

    def _check(self, resources: TaskResources) -> None:
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        cores = max((node.get("CPU", 0.0) for node in nodes), default=0.0)
        memory = max((node.get("memory", 0.0) for node in nodes), default=0.0) / 1e9
        if cores < resources.cores:
            raise ToolkitError(
                f"a task needs {resources.cores} cores, but the largest node of the cluster has "
                f"{cores:g}; use fewer threads"
            )
        if memory < resources.memory_gb:
            raise ToolkitError(
                f"a task needs {resources.memory_gb:g} GB, but the largest node of the cluster "
                f"has {memory:.1f} GB; declare less memory"
            )


@contextmanager
def ray_cluster(options: RayOptions) -> Iterator[RayCluster]:
    """Start a cluster on this machine, or join an existing one, until the block ends.

    A cluster on this machine listens on localhost only, without dashboard and usage statistics. Ray
    still asks the metadata service of clouds (169.254.169.254) whether it is in one; no option of
    Ray prevents this.

    Raises:
        DependencyError: ray is not installed.
        SettingsError: there is no cluster at the address.
    """
    os.environ.update(_VARIABLES if options.address else _VARIABLES | _LOCAL_ONLY)
    try:
        ray: Any = importlib.import_module("ray")
    except ModuleNotFoundError as error:
        raise DependencyError(
            "tasks on a cluster need ray; install it: pip install 'semsplat[cluster]'"
        ) from error
    common = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": False}
    try:
        if options.address is None:
            # Without "local", Ray would join a cluster that someone else has started here.
            ray.init(
                address="local",
                num_cpus=options.cpus,
                object_store_memory=max(options.object_store_mb, _MIN_OBJECT_STORE_MB) * 1_000_000,
                include_dashboard=False,
                _node_ip_address=_LOCALHOST,
                **common,
            )
        else:
            _check_reachable(options.address)
            ray.init(address=options.address, **common)
    except (OSError, ValueError, RuntimeError) as error:
        if options.address is None:
            raise
        raise SettingsError(
            f"--ray.address {options.address}: there is no cluster, or it refuses connections "
            f"({' '.join(str(error).split())}); if it requires a token, set RAY_AUTH_MODE=token"
        ) from error
    try:
        yield RayCluster(ray)
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Connect once to HOST:PORT, because Ray retries for minutes."""
    host, separator, port = address.rpartition(":")
    if separator and "://" not in address:
        socket.create_connection((host.strip("[]"), int(port)), _PATIENCE_S).close()


class OnRay:
    """Executes each job as one task; see Executor.

    A job whose worker was lost, or was killed for its memory, is resumed."""

    def __init__(self, cluster: RayCluster, resources: Resources) -> None:
        self._cluster = cluster
        self._resources = TaskResources(resources.threads, resources.memory_gb, resources.retries)

    def execute(self, jobs: Sequence[RunJob]) -> Iterator[RunOutcome]:
        """See Executor."""
        for result in self._cluster.unordered(_execute, jobs, self._resources):
            name = jobs[result.index].name
            yield result.value or RunOutcome(name, result.failure, 0.0)


def _execute(job: RunJob) -> RunOutcome:
    outcome = execute_run(job, worker=f"ray worker {os.getpid()}")
    if outcome.killed:
        raise ProcessKilledError(outcome.reason)
    return outcome
