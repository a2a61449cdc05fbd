"""Loops in rooms that have changed when the camera returns, with and without objects.

python -m benchmarks.loops.changed_rooms
python -m benchmarks.loops.changed_rooms --only 'ring-changed, images'
"""

from __future__ import annotations

from typing import Any

from benchmarks.loops.detection import COLUMNS, each_seed, measure
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import table_of

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


ROOMS = (
    *("ring-small", "ring-moved", "ring-light", "ring-evening", "ring-repainted", "ring-changed"),
    *("twins-small", "twins-objects"),
)
PAGE = Page(
    "changed_rooms",
    "Loops in changed rooms",
    TEXT,
    {
        f"{room}, {name}": {"sequence": room, "image_size": (160, 120), **row}
        for room in ROOMS
        for name, row in ROWS.items()
    },
    measure,
    lambda rows: [table_of((*COLUMNS, "time.online_ms_per_frame"), rows), *each_seed(rows)],
    seeds=5,
)

if __name__ == "__main__":
    PAGE.main()
