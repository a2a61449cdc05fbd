"""Execute one run as a process with the specified number of threads.

The process (`tools/cli/planned_run.py`) ends when the one that started it ends, however that
happens: it watches its standard input, a pipe that the system closes then. Otherwise a run whose
worker was lost would continue beside the process that resumes it.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

_SIGKILL = 9

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)


@dataclass(frozen=True)
class RunJob:
    """What a worker needs to execute one run; small, because it travels to the worker.

    Attributes:
        name: name of the run in the plan.
        folder: run folder.
        config: content of its config.yaml.
        logs: folder of the log files of all runs.
        threads: number of threads.
    """

    name: str
    folder: Path
    config: str
    logs: Path
    threads: int

    @property
    def settings_file(self) -> Path:
        """Settings of the run."""
        return self.logs / f"{self.name}.yaml"

    @property
    def log_file(self) -> Path:
        """Output of the run's process."""
        return self.logs / f"{self.name}.txt"

    @property
    def attempts_file(self) -> Path:
        """One line of JSON for each time that the run was started."""
        return self.logs / f"{self.name}.attempts.jsonl"

    @property
    def attempts(self) -> int:
        """How often the run was started."""
        try:
            return len(self.attempts_file.read_text(encoding="utf-8").splitlines())
        except FileNotFoundError:
            return 0


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended.

    Attributes:
        name: name of the run in the plan.
        reason: why it failed; empty if it finished.
        time_s: wall-clock time of the last attempt, seconds.
        killed: whether its process was killed (SIGKILL), as the kernel does for lack of memory.
    """

    name: str
    reason: str
    time_s: float
    killed: bool = False


def execute_run(job: RunJob, worker: str = "") -> RunOutcome:
    """Execute or resume a run as a process, and wait for it.

    Args:
        worker: description of the worker for the file of attempts.
    """
    begin = time.monotonic()
    job.folder.parent.mkdir(parents=True, exist_ok=True)
    job.settings_file.parent.mkdir(parents=True, exist_ok=True)
    job.settings_file.write_text(job.config, encoding="utf-8")
    environment = os.environ | dict.fromkeys(_THREAD_VARIABLES, str(job.threads))
    command = [sys.executable, "-m", "toolkit.tools.cli.planned_run", str(job.settings_file)]
    with job.log_file.open("ab") as log:
        process = subprocess.Popen(
            [*command, str(job.folder)],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=environment,
        )
        _note_attempt(job, process.pid, worker)
        try:
            status = process.wait()
        finally:
            if process.poll() is None:  # interrupted
                process.kill()
                process.wait()
            assert process.stdin is not None
            process.stdin.close()
    killed = status == -_SIGKILL
    return RunOutcome(job.name, _reason(job, status), time.monotonic() - begin, killed)


def _note_attempt(job: RunJob, pid: int, worker: str) -> None:
    line = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "host": socket.gethostname(),
        "worker_pid": os.getpid(),
        "run_pid": pid,
        "worker": worker,
        "resumed": (job.folder / "checkpoint/0/metadata.json").exists()
        or (job.folder / "checkpoint/1/metadata.json").exists(),
    }
    with job.attempts_file.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _reason(job: RunJob, status: int) -> str:
    """Return why a run failed, from its exit status and the end of its output."""
    if status == 0:
        if (job.folder / "report.html").is_file():
            return ""
        return f"the run has no map; see {job.folder / 'log.txt'}"
    if status == -_SIGKILL:
        return f"the process was killed, probably for lack of memory; see {job.log_file}"
    if status < 0:
        return f"the process was ended by signal {-status}; see {job.log_file}"
    lines = job.log_file.read_text(encoding="utf-8", errors="replace").split("\n")
    prefix = "semsplat: error: "
    last = next((line for line in reversed(lines) if line.strip()), "")
    if last.startswith(prefix):
        return last.removeprefix(prefix)
    return f"exit status {status}: {last.strip()}; see {job.log_file}"
