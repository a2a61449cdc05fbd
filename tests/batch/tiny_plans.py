"""Plans over tiny rooms, executed as users do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import yaml

OPTIONS = {
    "mapping": {
        "first_iterations": 8,
        "iterations": 3,
        "final_iterations": 1,
        "keyframes": {"interval": 1},
    },
    # A checkpoint per keyframe.
    "checkpoint": {"every_keyframes": 1},
}


def write_plan(path: Path, rooms: Path, *names: str, **more: object) -> Path:
    """Write a plan with one sequence per recording."""
    sequences = {n: {"dataset": {"kind": "synthetic", "path": str(rooms / n)}} for n in names}
    content = {"sequences": sequences, "settings": {"quick": {"options": OPTIONS}}, **more}
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path


def semsplat(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "toolkit.tools.cli.main", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240)
