"""Plans over tiny rooms, executed as users do."""

from __future__ import annotations

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
