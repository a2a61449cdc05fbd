"""Start programs: those of semsplat, those of earlier commits, and workers that answer lines."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmarks.shared.repository import ROOT


def semsplat_command(*arguments: str) -> list[str]:
    """The command line of a program, with the interpreter of this process."""
    return [sys.executable, "-m", "toolkit.tools.cli.main", *arguments]


def semsplat(*arguments: str) -> None:
    """Execute a program to its end.

    Raises:
        SystemExit: it failed.
    """
    done = finished_semsplat(*arguments)
    if done.returncode:
        raise SystemExit(f"semsplat {' '.join(arguments)}\n{done.stderr[-2000:]}")


def finished_semsplat(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Execute a program to its end, whatever its status."""
    command = semsplat_command(*arguments)
    return subprocess.run(command, capture_output=True, text=True, check=False)


def start_semsplat_server(*arguments: str) -> tuple[subprocess.Popen[str], str]:
    """Start a program that prints its address, and return it with the address.

    Raises:
        SystemExit: it ended without one.
    """
    command = semsplat_command(*arguments)
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert server.stdout is not None
    words = [word for word in server.stdout.readline().split() if word.startswith("http://")]
    if not words:
        raise SystemExit(f"semsplat {arguments[0]} did not start: {server.communicate()[1][-500:]}")
    return server, words[0].rstrip("/;")


@contextmanager
def earlier_tree(commit: str) -> Iterator[Path]:
    """A compiled checkout of a commit, which exists within this context."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            build = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
            subprocess.run(build, cwd=tree, check=True)
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


class LineWorker:
    """A process that answers lines, with the toolkit of a source tree."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ask(self, request: str) -> None:
        """Send a line."""
        assert self._process.stdin is not None
        self._process.stdin.write(request + "\n")
        self._process.stdin.flush()

    def answer(self) -> str:
        """The rest of the next line that begins with "answer ".

        Raises:
            SystemExit: the process ended without one.
        """
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("answer "):
                return line.removeprefix("answer ").rstrip("\n")
        raise SystemExit(f"the worker ended with status {self._process.wait()}")


@contextmanager
def line_worker(
    tree: Path, program: Sequence[str], variables: Mapping[str, str] | None = None
) -> Iterator[LineWorker]:
    """A worker that runs within this context.

    Args:
        tree: where its modules are found.
        program: a file, or "-m" and a module, with arguments.
        variables: additional environment variables.
    """
    process = subprocess.Popen(
        # -P: the folder of the program would be searched first for modules.
        [sys.executable, "-P", *program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **(variables or {}), "PYTHONPATH": str(tree)},
        cwd=tree,
    )
    try:
        yield LineWorker(process)
    finally:
        process.kill()
        process.wait()
