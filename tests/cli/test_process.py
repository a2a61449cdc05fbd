"""Programs in surroundings that lack something: a folder, memory, a reader of their output."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from toolkit.base.errors import DependencyError
from toolkit.io.arrays import write_array_tree
from toolkit.tools.cli.errors import explain

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = [sys.executable, "-m", "toolkit.tools.cli.main"]
SURROUNDINGS = os.environ | {"PYTHONPATH": str(ROOT)}


def test_a_removed_working_folder_is_reported(tmp_path: Path):
    folder = tmp_path / "gone"
    folder.mkdir()
    shell = f'rmdir "{folder}" && exec "$0" "$@"'
    done = subprocess.run(
        ["sh", "-c", shell, *PROGRAM, "render", str(tmp_path), "--out", str(tmp_path / "out")],
        cwd=folder,
        env=SURROUNDINGS,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("semsplat: error: the working folder cannot be used")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("threads", ["abc", "0", "-1", "2.5", ""])
def test_a_number_of_threads_that_is_none_is_reported(tmp_path: Path, threads: str):
    done = subprocess.run(
        [*PROGRAM, "render", str(tmp_path), "--out", str(tmp_path / "out")],
        env=SURROUNDINGS | {"OMP_NUM_THREADS": threads},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"semsplat: error: OMP_NUM_THREADS is {threads!r}")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("words", [("--help",), ("--version",), ("run", "--help-all")])
def test_a_reader_that_stops_reading_is_no_error(words: tuple[str, ...]):
    process = subprocess.Popen(
        [*PROGRAM, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=SURROUNDINGS
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 1


def test_a_client_that_leaves_concurrent_tasks_is_no_error():
    job = (
        "from toolkit.tools.cli.errors import one_line_errors\n"
        "def job():\n"
        "    raise ExceptionGroup('tasks', [ExceptionGroup('task', [BrokenPipeError(32, 'x')])])\n"
        "raise SystemExit(one_line_errors(job))"
    )
    done = subprocess.run([sys.executable, "-c", job], env=SURROUNDINGS, capture_output=True)
    assert done.returncode == 1 and done.stderr == b""


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_are_no_error(tmp_path: Path, closed: str):
    done = subprocess.run(
        ["sh", "-c", f'"$0" "$@" {closed}', *PROGRAM, "--version"],
        env=SURROUNDINGS,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and done.stderr == ""
    assert bool(done.stdout) == (closed in ("<&-", "2>&-"))


def test_little_memory_is_reported_in_one_line(tmp_path: Path):
    limit = 600 << 20
    done = subprocess.run(
        [*PROGRAM, "render", str(tmp_path), "--out", str(tmp_path / "out")],
        env=SURROUNDINGS,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )
    assert done.returncode == 2
    assert "raise the limit: ulimit -v" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("kind", [ImportError, DependencyError])
def test_libraries_that_do_not_fit_into_memory_are_not_called_missing(kind: type[Exception]):
    message = explain(kind("libX.so: failed to map segment from shared object"))
    assert message is not None and "ulimit -v" in message


def test_folders_have_the_permissions_that_the_user_chose(tmp_path: Path):
    before = os.umask(0o077)
    try:
        write_array_tree(tmp_path / "private", {}, {})
    finally:
        os.umask(before)
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o700
