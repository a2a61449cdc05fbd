"""`semsplat run-many`: execute the runs of a plan, one after the other or on a cluster."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from tqdm import tqdm

from toolkit.batch.execution import Executor, Sequential, execute_plan, is_due, job_of
from toolkit.batch.plan import PlannedRun, PlannedRuns, load_plan
from toolkit.batch.process import RunOutcome
from toolkit.batch.state import run_state
from toolkit.batch.table import RunRow, run_row
from toolkit.cli.batch_programs import RunManyOptions

_FAILED = 1


def main(options: RunManyOptions) -> int:
    """Execute the runs of a plan.

    Returns:
        0 if all runs are finished, 1 if one failed.

    Raises:
        ToolkitError: the plan is wrong, or there is no cluster.
    """
    planned = load_plan(options.plan)
    if options.dry_run:
        return _list(planned)
    due = sum(is_due(run_state(run)) for run in planned.runs)
    print(f"{len(planned.runs)} runs in {planned.out}, {due} to execute", flush=True)
    planned.out.mkdir(parents=True, exist_ok=True)
    with _executor(options, planned) as executor, _Progress(planned, due) as progress:
        outcomes = execute_plan(planned, executor, progress.ended)
    rows = [
        run_row(run, outcome.reason, job_of(run, planned).attempts)
        for run, outcome in zip(planned.runs, outcomes, strict=True)
    ]
    return _finish(options, planned, rows)


def _list(planned: PlannedRuns) -> int:
    """Print all runs, their folders and what exists of them."""
    states = {run.name: run_state(run) for run in planned.runs}
    width = max(map(len, states))
    for run in planned.runs:
        print(f"{run.name:<{width}}  {states[run.name].text}")
    counts = Counter(state.state for state in states.values())
    parts = [f"{counts[s]} {s}" for s in ("finished", "unfinished", "new", "conflict") if counts[s]]
    resources = planned.resources
    print(
        f"{len(states)} runs in {planned.out}: {', '.join(parts)}; {resources.threads} thread(s) "
        f"and {resources.memory_gb:g} GB each"
    )
    return _FAILED if counts["conflict"] else 0


def _finish(options: RunManyOptions, planned: PlannedRuns, rows: list[RunRow]) -> int:
    """Write table and report, and print the failures."""
    # Imports OpenCV and matplotlib, which take time.
    from toolkit.batch.report import write_batch_report

    report = write_batch_report(planned.out, options.plan.stem, rows)
    failed = [row for row in rows if row.reason]
    for row in failed:
        print(f"failed: {row.run.name}: {row.reason}", file=sys.stderr)
    print(f"{len(rows) - len(failed)} of {len(rows)} runs finished: {report}")
    return _FAILED if failed else 0


@contextmanager
def _executor(options: RunManyOptions, planned: PlannedRuns) -> Iterator[Executor]:
    if not options.use_ray:
        yield Sequential()
        return
    from toolkit.batch.on_ray import OnRay
    from toolkit.cluster.session import ray_cluster

    with ray_cluster(options.ray) as cluster:
        yield OnRay(cluster, planned.resources)


class _Progress:
    """Prints one line per ended run, and a bar on a terminal."""

    def __init__(self, planned: PlannedRuns, due: int) -> None:
        self._runs = {run.name: run for run in planned.runs}
        self._bar = tqdm(total=due, unit="run", file=sys.stderr, disable=not sys.stderr.isatty())
        self._due, self._ended = due, 0

    def __enter__(self) -> _Progress:
        self._bar.refresh()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def ended(self, outcome: RunOutcome) -> None:
        """Report the end of a run."""
        self._ended += 1
        text = _summary(self._runs[outcome.name], outcome)
        tqdm.write(f"[{self._ended}/{self._due}] {outcome.name}: {text}", file=sys.stderr)
        self._bar.update()


def _summary(run: PlannedRun, outcome: RunOutcome) -> str:
    if outcome.reason:
        return f"failed: {outcome.reason}"
    metrics = run_row(run, "", 1).metrics
    parts = [f"finished in {outcome.time_s:.0f} s"]
    for key, text in (("ate_rmse_cm", "ATE {:.2f} cm"), ("psnr_db", "PSNR {:.1f} dB")):
        if metrics.get(key) is not None:
            parts.append(text.format(metrics[key]))
    return ", ".join(parts)
