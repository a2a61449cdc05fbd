"""Start the programs of semsplat, each in a process of its own."""

from __future__ import annotations

import configparser
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path


def semsplat_command(*arguments: str) -> list[str]:
    """The command line of a program, with the interpreter of this process."""
    return [sys.executable, "-m", "toolkit.tools.cli.main", *arguments]


def semsplat(*arguments: str, variables: Mapping[str, str] | None = None) -> None:
    """Execute a program to its end.

    Args:
        variables: additional environment variables.

    Raises:
        SystemExit: it failed.
    """
    command = semsplat_command(*arguments)
    environment = {**os.environ, **(variables or {})}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise SystemExit(f"semsplat {' '.join(arguments)}\n{done.stderr[-2000:]}")


def semsplat_of(tree: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Execute a program of a source tree to its end, whatever its status."""
    return subprocess.run(
        # -P: the current folder would be searched first for modules.
        [sys.executable, "-P", "-m", _program(tree), *arguments],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
        check=False,
    )


def _program(tree: Path) -> str:
    """The module of the command in a source tree, whose packages may have other names."""
    settings = configparser.ConfigParser()
    settings.read(tree / "setup.cfg", encoding="utf-8")
    script = settings["options.entry_points"]["console_scripts"]
    return script.partition("=")[2].partition(":")[0].strip()


def start_semsplat(*arguments: str) -> subprocess.Popen[str]:
    """Start a program and return at once; its messages are discarded."""
    command = semsplat_command(*arguments)
    return subprocess.Popen(command, stderr=subprocess.DEVNULL, text=True)


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
