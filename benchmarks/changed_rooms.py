"""Loops in rooms that have changed when the camera returns, with and without objects.

python -m benchmarks.changed_rooms
python -m benchmarks.changed_rooms --rooms twins-small twins-objects --seeds 5
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import tyro

from benchmarks.loops import COLUMNS, each_seed, measure
from benchmarks.report import Report, ReportOptions
from benchmarks.tables import table_of

_OBJECTS = {"loops": {"objects": {"use": True}}}
ROWS: dict[str, dict[str, Any]] = {
    "images": {"loops": {}},
    "images and objects": _OBJECTS,
    "images and instances": _OBJECTS | {"instances": "folder"},
    "images and geometric instances": _OBJECTS | {"instances": "geometric"},
}
TEXT = """\
The camera returns to the first of four rooms (450 frames, 160x120, sensor noise, true labels with
errors). There, most objects have moved (ring-moved), the lamps are off (ring-light), objects have
moved and one warm lamp is on (ring-evening), every surface is repainted in this light
(ring-repainted), or all of this (ring-changed). Runs without the final refinement, with loops from
images alone and with constellations of objects (`--loops.objects.use`) where images do not match.
The objects are connected components of the classes of Gaussians. In the rows with instances, those
from true masks or from masks of `--instances.kind geometric` are compared as well.
"Suspected" metrics are those of the candidates by descriptors, "verified" those of the loops held
at the end. A false edge places an anchor more than half a metre from where the truth has it. In
twins, two of three rooms are identical."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure loops in rooms that have changed."""

    rooms: tuple[str, ...] = (
        "ring-small",
        "ring-moved",
        "ring-light",
        "ring-evening",
        "ring-repainted",
        "ring-changed",
        "twins-small",
        "twins-objects",
    )
    """Synthetic sequences."""
    seeds: int = 5
    """Seeds 0, 1, ... of rooms and runs."""


def main() -> None:
    """Measure all rooms."""
    options = tyro.cli(Options)
    report = Report("changed_rooms", "Loops in changed rooms", TEXT, options, range(options.seeds))
    jobs = {
        f"{room}, {name}": {
            "sequence": room, "image_size": (160, 120), "cover": None, **row
        }
        for room in options.rooms
        for name, row in ROWS.items()
    }  # fmt: skip
    found = report.measured(jobs, measure)
    tables = [table_of((*COLUMNS, "time.online_ms_per_frame"), found)]
    if options.seeds > 1:
        tables.append(each_seed(found, options.seeds))
    report.write(*tables)


if __name__ == "__main__":
    main()
