"""Execute the runs of a plan as tasks on a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

from toolkit.batch.plan import Resources
from toolkit.batch.process import RunJob, RunOutcome, execute_run
from toolkit.batch.ray_cluster import ProcessKilledError, RayCluster, TaskResources


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
