"""Export floor plans as images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toolkit.exports.floors import required_ground
from toolkit.exports.selection import SelectedGaussians
from toolkit.io.images import write_png
from toolkit.semantics.floor_plan import FloorPlan, draw_floor_plan, floor_plan
from toolkit.semantics.palette import Palette


def export_floor_plan(
    path: Path, selection: SelectedGaussians, floor: Sequence[str] = ()
) -> FloorPlan:
    """Write the floor plan of the selected Gaussians as a PNG.

    Raises:
        ToolkitError: the map has no labels, no floor was found, or the file cannot be written.
    """
    opaque = selection.opaque()
    labelled = opaque.labelled()
    ground = required_ground(selection, floor)
    palette = Palette(labelled.taxonomy)
    cameras_m = selection.run.trajectory.positions_m
    radii_m = opaque.gaussians.radii_m.numpy().astype(float)
    plan = floor_plan(labelled, radii_m, ground, cameras_m, palette)
    write_png(path, draw_floor_plan(plan, palette, names=selection.run.length_names))
    return plan
