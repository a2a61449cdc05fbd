"""`semsplat export`: write a map as splats, mesh or point cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from toolkit.cli.programs import ExportOptions
from toolkit.errors import ToolkitError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.io.meshes import write_mesh
from toolkit.io.splats import SplatLabels, export_splats, read_splats
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.runs.labelled import load_labelled_run
from toolkit.runs.meshing import MeshOptions, part_mesh, surface_mesh, write_opaque_points


@dataclass(frozen=True)
class _Selection:
    """The selected Gaussians of a run and their labels."""

    run: FinishedRun
    gaussians: GaussianCloud
    labels: SplatLabels | None


def main(options: ExportOptions) -> int:
    """Export a map.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run, no Gaussian is selected, or the file cannot be
            written.
    """
    selection = _select(options)
    if options.kind == "splats":
        columns = None if selection.labels is None else selection.labels.columns()
        export_splats(options.to, selection.gaussians, columns)
        content = f"{len(selection.gaussians)} Gaussians"
    elif options.kind == "points":
        content = f"{write_opaque_points(options.to, selection.gaussians)} points"
    else:
        fuse = part_mesh if options.keep or options.drop else surface_mesh
        mesh_options = MeshOptions(options.voxel_m, options.max_depth_m, options.every)
        mesh = fuse(selection.run, selection.gaussians, mesh_options)
        write_mesh(options.to, mesh)
        content = str(mesh)
    print(f"wrote {content} to {options.to}")
    return 0


def _select(options: ExportOptions) -> _Selection:
    """Select the Gaussians of a run by --keep and --drop.

    Raises:
        ToolkitError: no Gaussian is selected, or classes are given but the map has no labels.
    """
    if not options.keep and not options.drop:
        run = load_run(options.run)
        return _Selection(run, run.gaussians, read_splats(run.folder.map).labels)
    labelled = load_labelled_run(options.run)
    mask = np.ones(len(labelled.map), bool)
    if options.keep:
        mask = labelled.select(options.keep)
    mask &= ~labelled.map.selected(options.drop)
    if not mask.any():
        raise ToolkitError(f"--keep and --drop exclude all Gaussians of {options.run}")
    gaussians = labelled.run.gaussians.select(torch.from_numpy(mask))
    return _Selection(labelled.run, gaussians, labelled.map.labels.select(mask))
