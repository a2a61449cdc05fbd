"""`semsplat run-many`: execute the runs of a plan, one after the other or on a cluster."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from tqdm import tqdm

from toolkit.base.printable import printable
from toolkit.runs.batch.execution import Executor, Sequential, execute_plan, is_due, job_of
from toolkit.runs.batch.plan import PlannedRun, PlannedRuns, load_plan
from toolkit.runs.batch.process import RunOutcome
from toolkit.runs.batch.state import checkpoint_frame, run_state
from toolkit.runs.batch.table import RunRow, run_row
from toolkit.runs.evaluation.metrics import ate_frames
from toolkit.tools.cli.batch_programs import RunManyOptions

_FAILED = 1
# Seconds between reports of progress, on a terminal and in a log, and the number of runs in them.
_BAR_INTERVAL_S, _LINE_INTERVAL_S = 2.0, 60.0
_SHOWN = 3


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
    from toolkit.runs.batch.report import write_batch_report

    report = write_batch_report(planned.out, options.plan.stem, rows)
    failed = [row for row in rows if row.reason]
    for row in failed:
        print(printable(f"failed: {row.run.name}: {row.reason}"), file=sys.stderr)
    print(f"{len(rows) - len(failed)} of {len(rows)} runs finished: {report}")
    return _FAILED if failed else 0


@contextmanager
def _executor(options: RunManyOptions, planned: PlannedRuns) -> Iterator[Executor]:
    if not options.use_ray:
        yield Sequential()
        return
    from toolkit.runs.batch.ray_cluster import OnRay, ray_cluster

    with ray_cluster(options.ray) as cluster:
        yield OnRay(cluster, planned.resources)


class _Progress:
    """Prints a line per ended run and, on the way, the frames that the running ones have saved."""

    def __init__(self, planned: PlannedRuns, due: int) -> None:
        self._runs = {run.name: run for run in planned.runs}
        self._jobs = {run.name: job_of(run, planned) for run in planned.runs}
        # Attempts before this call, to recognise runs that have not begun yet.
        self._before = {name: job.attempts for name, job in self._jobs.items()}
        self._bar = tqdm(total=due, unit="run", disable=None)
        self._interval_s = _LINE_INTERVAL_S if self._bar.disable else _BAR_INTERVAL_S
        self._due, self._ended = due, set[str]()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> _Progress:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._bar.close()

    def ended(self, outcome: RunOutcome) -> None:
        """Report the end of a run."""
        self._ended.add(outcome.name)
        text = _summary(self._runs[outcome.name], outcome)
        tqdm.write(f"[{len(self._ended)}/{self._due}] {outcome.name}: {text}", file=sys.stderr)
        self._bar.update()

    def _watch(self) -> None:
        while not self._stop.wait(self._interval_s):
            text = running_text(self._running())
            if self._bar.disable:
                print(f"running: {text}", file=sys.stderr, flush=True)
            else:
                self._bar.set_postfix_str(text)

    def _running(self) -> dict[str, int]:
        """Frames saved so far of the runs that have begun and not ended, by name."""
        return {
            name: checkpoint_frame(job.folder) or 0
            for name, job in self._jobs.items()
            if name not in self._ended and job.attempts > self._before[name]
        }


def running_text(frames: Mapping[str, int]) -> str:
    """Return the progress of running runs, at most three by name."""
    shown = [f"{name} frame {frame}" for name, frame in list(frames.items())[:_SHOWN]]
    more = len(frames) - len(shown)
    return ", ".join([*shown, *([f"{more} more"] if more > 0 else [])]) or "none"


def _summary(run: PlannedRun, outcome: RunOutcome) -> str:
    if outcome.reason:
        return f"failed: {outcome.reason}"
    metrics = run_row(run, "", 1).metrics
    parts = [f"finished in {outcome.time_s:.0f} s"]
    for key, text in (
        ("trajectory.ate_rmse_cm", "ATE {:.2f} cm {frames}"),
        ("images.mapped.psnr_db", "PSNR {:.1f} dB"),
    ):
        if metrics.get(key) is not None:
            parts.append(text.format(metrics[key], frames=ate_frames(metrics)).strip())
    return ", ".join(parts)
