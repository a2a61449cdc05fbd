"""`semsplat export`: write a map as splats, mesh or point cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import ExportOptions
from toolkit.errors import FormatError, SettingsError, ToolkitError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.io.meshes import MESH_SUFFIXES, POINT_SUFFIXES, write_mesh
from toolkit.io.splats import SUFFIXES, SplatLabels, export_splats, read_splats
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.runs.labelled import load_labelled_run
from toolkit.runs.shapes import MeshOptions, part_mesh, surface_mesh, write_solid_points

_ENDINGS = {"splats": SUFFIXES, "mesh": MESH_SUFFIXES, "points": POINT_SUFFIXES}


@dataclass(frozen=True)
class _Part:
    """What is exported of a run."""

    run: FinishedRun
    gaussians: GaussianCloud
    labels: SplatLabels | None


def main(argv: Sequence[str]) -> int:
    """Export a map.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run, the ending is unknown, a value is out of
            range or the file cannot be written.
    """
    options = parse_arguments(ExportOptions, argv, "export")
    kind = _kind(options)
    mesh_options = MeshOptions(options.voxel_m, options.max_depth_m, options.every)
    if not options.to.parent.is_dir():
        raise FormatError(f"--to {options.to}: there is no folder {options.to.parent}; make it")
    part = _part(options)
    if kind == "splats":
        columns = None if part.labels is None else part.labels.columns()
        export_splats(options.to, part.gaussians, columns)
        what = f"{len(part.gaussians)} Gaussians"
    elif kind == "points":
        what = f"{write_solid_points(options.to, part.gaussians)} points"
    else:
        fuse = part_mesh if options.keep or options.drop else surface_mesh
        mesh = fuse(part.run, part.gaussians, mesh_options)
        write_mesh(options.to, mesh)
        what = str(mesh)
    print(f"wrote {what} to {options.to}")
    return 0


def _kind(options: ExportOptions) -> str:
    """One of `_ENDINGS`, by the switches or else by the name.

    Raises:
        SettingsError: both switches are given.
        FormatError: the ending does not fit.
    """
    name = options.to.name.lower()
    if options.mesh and options.points:
        raise SettingsError("give --mesh or --points, not both: a file holds one of them")
    if options.mesh or name.endswith(".mesh.ply"):
        kind = "mesh"
    elif options.points or name.endswith(".pcd"):
        kind = "points"
    else:
        kind = "splats"
    if options.to.suffix not in _ENDINGS[kind]:
        raise FormatError(
            f"--to {options.to}: the file must end in {', '.join(_ENDINGS[kind])} for {kind} "
            "(.mesh.ply or --mesh for a mesh, .pcd or --points for points)"
        )
    return kind


def _part(options: ExportOptions) -> _Part:
    """The Gaussians that --keep and --drop leave of a run.

    Raises:
        ToolkitError: they leave nothing, or the map has no labels to choose by.
    """
    if not options.keep and not options.drop:
        run = load_run(options.run)
        return _Part(run, run.gaussians, read_splats(run.folder.map).labels)
    labelled = load_labelled_run(options.run)
    kept = np.ones(len(labelled.map), bool)
    if options.keep:
        kept = labelled.holding(options.keep)
    kept &= ~labelled.map.selected(options.drop)
    if not kept.any():
        raise ToolkitError(f"--keep and --drop leave nothing of {options.run} to write")
    gaussians = labelled.run.gaussians.select(torch.from_numpy(kept))
    return _Part(labelled.run, gaussians, labelled.map.labels.select(kept))
