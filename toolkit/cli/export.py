"""`semsplat export`: write a map as splats, mesh or point cloud."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.finished_run import FinishedRun, open_finished_run
from toolkit.errors import FormatError, SettingsError
from toolkit.geometry import se3
from toolkit.io.meshes import (
    MESH_SUFFIXES,
    POINT_SUFFIXES,
    DepthView,
    fuse_views,
    write_mesh,
    write_points,
)
from toolkit.io.splats import SUFFIXES, export_splats
from toolkit.rendering import DrawOptions, backend, draw_surface

_ENDINGS = {"splats": SUFFIXES, "mesh": MESH_SUFFIXES, "points": POINT_SUFFIXES}

# Gaussians thinner than this are haze, not surface.
_LEAST_OPACITY = 0.5
_LEAST_SILHOUETTE = 0.9


@dataclass(frozen=True)
class ExportOptions:
    """Write the map of a finished run for other programs."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    to: Path
    """File to write: splats as .ply, .splat or .spz; a mesh as .mesh.ply; points as .pcd."""
    mesh: bool = False
    """Write a mesh (.ply), fused from rendered depth and colour at the run's poses."""
    points: bool = False
    """Write a point cloud (.ply, .pcd): the centres of the solid Gaussians."""
    voxel_m: float = 0.015
    """Edge of the mesh's voxels in metres; memory grows with its inverse square."""
    max_depth_m: float = 6.0
    """Farthest depth that enters the mesh, metres."""
    every: int = 3
    """Of the run's poses, the mesh uses every n-th."""


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
    _check_values(options)
    run = open_finished_run(options.run)
    if kind == "splats":
        export_splats(options.to, run.gaussians)
        what = f"{len(run.gaussians)} Gaussians"
    elif kind == "points":
        solid = run.gaussians.select(run.gaussians.opacities >= _LEAST_OPACITY)
        write_points(options.to, solid.means.numpy(), solid.colours.numpy())
        what = f"{len(solid)} points"
    else:
        mesh = fuse_views(_views(run, options.every), options.voxel_m, options.max_depth_m)
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


def _check_values(options: ExportOptions) -> None:
    for name in ("voxel_m", "max_depth_m", "every"):
        value = getattr(options, name)
        if not value > 0:
            raise SettingsError(f"--{name.replace('_', '-')} must be positive, got {value}")
    if not options.to.parent.is_dir():
        raise FormatError(f"--to {options.to}: there is no folder {options.to.parent}; make it")


def _views(run: FinishedRun, every: int) -> Iterator[DepthView]:
    """The map as the run's camera saw it."""
    camera = run.open_dataset().camera
    frames = run.tracked[::every]
    for frame in tqdm(frames, unit="view", file=sys.stderr, disable=not sys.stderr.isatty()):
        drawn = draw_surface(
            backend(run.settings.backend),
            run.gaussians,
            camera,
            se3.inverse(frame.T_map_camera),
            DrawOptions(_LEAST_SILHOUETTE),
        )
        rgb = np.clip(drawn.output.colour.numpy(), 0.0, 1.0)
        yield DepthView(camera, frame.T_map_camera, rgb, drawn.depth_m.numpy())
