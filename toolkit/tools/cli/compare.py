"""`semsplat compare`: compare runs on one HTML page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.exports.map_changes import changes_between, require_metres
from toolkit.exports.mapped_scene import map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.selection import select
from toolkit.io.atomic import utf8, write_text
from toolkit.runs.evaluation.comparison import render_comparison, setting_rows
from toolkit.runs.maps.comparing import compared_run
from toolkit.runs.maps.registering import relative_pose
from toolkit.scene.graph.changes import MapChanges
from toolkit.tools.cli.programs import CompareOptions


def main(options: CompareOptions) -> int:
    """Compare runs.

    Returns:
        0.

    Raises:
        ToolkitError: a folder contains no finished run, the page cannot be written, or the objects
            of the runs cannot be compared.
    """
    names = unique_names(options.runs)
    runs = [
        compared_run(path, name, options.out)
        for path, name in zip(options.runs, names, strict=True)
    ]
    found = None if options.objects is None else _compared_objects(options)
    write_text(options.out, render_comparison(runs))
    print(f"compared {len(runs)} runs, {len(setting_rows(runs))} settings differ: {options.out}")
    if options.objects is not None and found is not None:
        _write_changes(options, options.objects, *found)
    return 0


def _compared_objects(options: CompareOptions) -> tuple[MapChanges, NDArray[np.float64]]:
    """Return the changed objects of the second run, and its pose in the first one."""
    selections = [select(path) for path in options.runs]
    runs = [selection.run for selection in selections]
    require_metres(*runs)  # before the search for a common frame
    T_before_after = np.eye(4)
    if not options.same_frame:
        T_before_after = relative_pose(runs[0], runs[1], options.registration)
    before, after = (map_scene(selection, ObjectGraphOptions()) for selection in selections)
    return changes_between(before, after, T_before_after), T_before_after


def _write_changes(
    options: CompareOptions, out: Path, found: MapChanges, T_before_after: NDArray[np.float64]
) -> None:
    """Write the changed objects of the second run, and print them."""
    content = {
        "before": str(options.runs[0]),
        "after": str(options.runs[1]),
        "T_before_after": T_before_after.tolist(),
        **found.values(),
    }
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_text(out, text)
    for change in found.changes:
        print(change)
    print(
        f"{found.unchanged} objects unchanged, {len(found.unknown)} seen by one run only; wrote "
        f"{out}"
    )


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Return names of folders: as many of their last parts as are needed to differ."""
    parts = [Path(utf8(str(path.resolve())).decode()).parts for path in paths]
    longest = max(map(len, parts))
    for length in range(1, longest + 1):
        names = ["/".join(p[-length:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{name} ({number})" for number, name in enumerate(names, start=1)]
