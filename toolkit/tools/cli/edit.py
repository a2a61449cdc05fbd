"""`semsplat edit`: remove, keep, move and recolour classes of a labelled map."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.io.atomic import cannot_write, write_text
from toolkit.io.images import write_png
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import write_splat_ply
from toolkit.io.visualisation import Panel, colour_image, strip
from toolkit.runs.maps.editing import EditedMap, EditedView, Edits, Paint, Shift, edit, view_edit
from toolkit.runs.maps.labelled import TAXONOMY, LabelledRun, load_labelled_run
from toolkit.runs.new_folder import NewFolder
from toolkit.tools.cli.map_programs import EditOptions

_HOLE_COLOUR = (255, 0, 200)


def main(options: EditOptions) -> int:
    """Edit a map and report the holes.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run with labels, a name is unknown or has no Gaussians,
            or the output folder cannot be written or is in use.
    """
    labelled = load_labelled_run(options.run)
    edited = edit(labelled, _edits(options))
    _create(options.out)
    with NewFolder(str(options.out), "edit", options).written():
        renders = options.out / "renders"
        _create(renders)
        comments = labelled.run.map_comments
        write_splat_ply(options.out / "map.ply", edited.gaussians, edited.columns, comments)
        labelled.map.taxonomy.save(options.out / TAXONOMY)
        views = _write_views(options, labelled, edited, renders)
        report = {"metric": labelled.run.metric, **_report(edited, views)}
        write_text(options.out / "edit.json", json.dumps(report, indent=1) + "\n")
    for line in _lines(report, labelled.run.length_names):
        print(line)
    print(f"wrote map.ply, {TAXONOMY}, edit.json and {len(views)} view(s) to {options.out}")
    return 0


def _edits(options: EditOptions) -> Edits:
    return Edits(
        options.remove,
        options.keep,
        [Shift(name, (x, y, z)) for name, x, y, z in options.move],
        [Paint(name, (r / 255, g / 255, b / 255)) for name, r, g, b in options.recolour],
        options.min_confidence,
    )


def _create(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _write_views(
    options: EditOptions, labelled: LabelledRun, edited: EditedMap, renders: Path
) -> dict[int, EditedView]:
    """Write the edited view, and it beside the original with holes marked, for some frames."""
    camera, views = labelled.run.camera, {}
    for frame in labelled.run.tracked[:: options.every]:
        view = view_edit(labelled, edited, camera, frame.T_map_camera)
        after = colour_image(view.after)
        marked = after.copy()
        marked[view.hole] = _HOLE_COLOUR
        panels = [
            Panel("before", colour_image(view.before)),
            Panel(f"after, holes {view.hole_percent:.1f} %", marked),
        ]
        write_png(renders / f"colour_{frame.index:06d}.png", after)
        write_png(renders / f"holes_{frame.index:06d}.png", strip(panels))
        views[frame.index] = view
    return views


def _report(edited: EditedMap, views: dict[int, EditedView]) -> dict[str, Any]:
    percent = {index: round(view.hole_percent, 3) for index, view in views.items()}
    worst = max(percent, key=lambda index: percent[index]) if percent else None
    return {
        "gaussians": len(edited.gaussians),
        "removed": int(edited.removed.sum()),
        "moved": int(edited.moved.sum()),
        "recoloured": int(edited.recoloured.sum()),
        "floor_hole_m2": None if edited.floor_hole_m2 is None else round(edited.floor_hole_m2, 4),
        "hole_percent": round(float(np.mean(list(percent.values()))), 3) if percent else None,
        "worst_view": worst,
        "hole_percent_by_view": percent,
        "hole_m2_by_view": {index: round(view.hole_m2, 4) for index, view in views.items()},
    }


def _lines(report: dict[str, Any], names: LengthNames) -> list[str]:
    lines = [
        f"removed {report['removed']}, moved {report['moved']} and recoloured "
        f"{report['recoloured']} Gaussians; {report['gaussians']} are left"
    ]
    if report["hole_percent"]:
        worst = report["worst_view"]
        lines.append(
            f"holes: {report['hole_percent']:.2f} % of the pixels of the views, at most "
            f"{report['hole_percent_by_view'][worst]:.2f} % "
            f"({report['hole_m2_by_view'][worst]:.2f} {names.area}) in frame {worst}"
        )
    elif report["hole_percent"] is not None:
        lines.append("holes: none in the rendered views")
    if report["floor_hole_m2"]:
        area = f"{report['floor_hole_m2']:.2f} {names.area}"
        lines.append(f"holes: {area} of the floor are missing there")
    return [*lines, *names.note_lines]
