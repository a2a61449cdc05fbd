"""Execute the runs of a plan, one after the other or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol

from toolkit.runs.batch.plan import PlannedRun, PlannedRuns
from toolkit.runs.batch.process import RunJob, RunOutcome, execute_run
from toolkit.runs.batch.state import RunState, planned_config, run_state

LOGS = "logs"

# Receives each outcome when its run ends.
Ended = Callable[[RunOutcome], None]


class Executor(Protocol):
    """Executes jobs; failures are outcomes, not exceptions."""

    def execute(self, jobs: Sequence[RunJob]) -> Iterable[RunOutcome]:
        """Execute jobs and yield their outcomes as they end."""
        ...


class Sequential:
    """Executes one job after the other on this machine."""

    def execute(self, jobs: Sequence[RunJob]) -> Iterator[RunOutcome]:
        """See Executor."""
        for job in jobs:
            yield execute_run(job)


def execute_plan(planned: PlannedRuns, executor: Executor, ended: Ended) -> list[RunOutcome]:
    """Execute the runs of a plan that are not finished; unfinished ones are resumed.

    Returns:
        Outcomes of all runs in the order of the plan; those of runs that were finished before
        have a time of 0.
    """
    states = {run.name: run_state(run) for run in planned.runs}
    outcomes = {
        name: RunOutcome(name, state.text if state.state == "conflict" else "", 0.0)
        for name, state in states.items()
    }
    jobs = [job_of(run, planned) for run in planned.runs if is_due(states[run.name])]
    for outcome in executor.execute(jobs):
        outcomes[outcome.name] = outcome
        ended(outcome)
    return [outcomes[run.name] for run in planned.runs]


def is_due(state: RunState) -> bool:
    """Whether a run must be started or resumed."""
    return state.state in ("new", "unfinished")


def job_of(run: PlannedRun, planned: PlannedRuns) -> RunJob:
    """Return what a worker needs to execute a run."""
    return RunJob(
        run.name,
        run.folder,
        planned_config(run),
        planned.out / LOGS,
        planned.resources.threads,
    )
