"""`semsplat export`: write a map for other programs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np

from toolkit.base.errors import SettingsError
from toolkit.exports.floors import export_occupancy_grid
from toolkit.exports.mapped_scene import map_scene
from toolkit.exports.options import FORMATS
from toolkit.exports.plans import export_floor_plan
from toolkit.exports.scene_graph import export_scene_graph, scene_graph
from toolkit.exports.selection import SelectedGaussians, select
from toolkit.exports.surfaces import export_gltf, export_labelled_points, export_scene_splats
from toolkit.exports.views import ViewExportOptions, export_colmap, export_nerfstudio
from toolkit.io.meshes import write_mesh
from toolkit.io.splat_placement import origin_comment, origin_in
from toolkit.io.splats import export_splats, is_splat_file, read_splats
from toolkit.io.suffixes import SCENE_SUFFIXES
from toolkit.io.trajectories import write_tum
from toolkit.runs.maps.labelled import taxonomy_of_file
from toolkit.runs.maps.meshing import MeshOptions, part_mesh, surface_mesh, write_opaque_points
from toolkit.runs.new_folder import NewFolder
from toolkit.tools.cli.map_programs import ExportOptions
from toolkit.tools.viewer.html import link_from_report, write_page
from toolkit.tools.viewer.reading import run_scene
from toolkit.tools.viewer.shown_objects import graph_objects

_log = logging.getLogger(__name__)


def main(options: ExportOptions) -> int:
    """Export a map.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run or splat file, no Gaussian is selected, the map lacks
            what the format needs, or the file cannot be written.
    """
    if is_splat_file(options.run):
        print(f"wrote {_converted(options)} to {options.to}")
        return 0
    selection = select(options.run, options.keep, options.drop)
    for note in selection.run.length_names.notes:
        _log.warning("%s: %s", options.to, note)
    with _new_folder(options):
        content = _WRITERS[options.kind](options, selection)
    print(f"wrote {content} to {options.to}")
    return 0


def _new_folder(options: ExportOptions) -> AbstractContextManager[None]:
    """What marks the folder while it is written; nothing for formats of one file."""
    if FORMATS[options.kind]:
        return nullcontext()
    return NewFolder(str(options.to), "export", options, "--to").written()


def _converted(options: ExportOptions) -> str:
    """Write the splats of a file, of any tool, in another format."""
    if options.kind != "splats" or options.keep or options.drop:
        raise SettingsError(
            f"{options.run} is a splat file, which can be written as whole splats only: give "
            "--format splats without --keep and --drop, or a run folder"
        )
    splats = read_splats(options.run)
    taxonomy = taxonomy_of_file(options.run, splats)
    tree = None if taxonomy is None else taxonomy.to_json()
    if options.to.suffix not in SCENE_SUFFIXES:
        _warn_of_origin(options, origin_comment(origin_in(splats.comments)))
    export_splats(options.to, splats, splats.extra, splats.comments, options.spz_version, tree)
    return f"{len(splats)} Gaussians"


def _splats(options: ExportOptions, selection: SelectedGaussians) -> str:
    comments = selection.run.map_comments
    if options.to.suffix in SCENE_SUFFIXES:
        # The transformation of the scene contains the origin.
        export_scene_splats(options.to, selection, comments, options.floor)
    else:
        _warn_of_origin(options, origin_comment(selection.run.origin_m))
        version, tree = options.spz_version, selection.class_tree
        export_splats(options.to, selection.gaussians, selection.columns, comments, version, tree)
    return f"{len(selection.gaussians)} Gaussians"


def _warn_of_origin(options: ExportOptions, origin: Sequence[str]) -> None:
    """Report the origin, if there is one, that a file in single precision cannot hold."""
    for line in origin:
        _log.warning("%s has single precision; add the %s to its positions", options.to, line)


def _points(options: ExportOptions, selection: SelectedGaussians) -> str:
    # Open3D writes .pcd in single precision.
    origin_m = selection.run.origin_m
    if options.to.suffix == ".pcd":
        _warn_of_origin(options, origin_comment(origin_m))
        origin_m = np.zeros(3)
    return f"{write_opaque_points(options.to, selection.gaussians, origin_m)} points"


def _trajectory(options: ExportOptions, selection: SelectedGaussians) -> str:
    trajectory = selection.run.trajectory.transformed(selection.run.T_given_map)
    write_tum(options.to, trajectory)
    return f"{len(trajectory)} poses"


def _labelled_points(options: ExportOptions, selection: SelectedGaussians) -> str:
    labelled = "" if selection.labels is None else " with classes"
    return f"{export_labelled_points(options.to, selection)} points{labelled}"


def _mesh(options: ExportOptions, selection: SelectedGaussians) -> str:
    fuse = part_mesh if selection.partial else surface_mesh
    mesh = fuse(selection.run, selection.gaussians, _mesh_options(options))
    write_mesh(options.to, mesh, selection.run.origin_m)
    return str(mesh)


def _gltf(options: ExportOptions, selection: SelectedGaussians) -> str:
    return str(export_gltf(options.to, selection, _mesh_options(options), options.floor))


def _colmap(options: ExportOptions, selection: SelectedGaussians) -> str:
    binary = options.kind == "colmap-binary"
    count = export_colmap(options.to, selection, _view_options(options), binary)
    return f"a COLMAP model of {count} images"


def _nerfstudio(options: ExportOptions, selection: SelectedGaussians) -> str:
    count = export_nerfstudio(options.to, selection, _view_options(options))
    return f"transforms.json of {count} images"


def _occupancy_grid(options: ExportOptions, selection: SelectedGaussians) -> str:
    return str(export_occupancy_grid(options.to, selection, options.grid, options.floor))


def _scene_graph(options: ExportOptions, selection: SelectedGaussians) -> str:
    graph = export_scene_graph(options.to, selection, options.objects, options.floor, options.grid)
    return str(graph)


def _floor_plan(options: ExportOptions, selection: SelectedGaussians) -> str:
    plan = export_floor_plan(
        options.to, selection, options.plan, options.objects, options.floor, options.grid
    )
    return str(plan)


def _viewer(options: ExportOptions, selection: SelectedGaussians) -> str:
    scene = run_scene(selection, options.viewer)
    if options.viewer.graph:
        mapped = map_scene(selection, options.objects, options.floor, options.grid)
        scene = replace(scene, objects=graph_objects(scene_graph(mapped).content))
    size = write_page(options.to, scene)
    if link_from_report(options.to, selection.run.folder.report):
        _log.info("Linked it from %s.", selection.run.folder.report)
    return f"a page of {size / 1e6:.1f} MB with {scene}"


def _mesh_options(options: ExportOptions) -> MeshOptions:
    return MeshOptions(options.voxel_m, options.max_depth_m, options.every)


def _view_options(options: ExportOptions) -> ViewExportOptions:
    return ViewExportOptions(options.images, options.every, options.max_points)


_WRITERS: dict[str, Callable[[ExportOptions, SelectedGaussians], str]] = {
    "splats": _splats,
    "mesh": _mesh,
    "points": _points,
    "labelled-points": _labelled_points,
    "gltf": _gltf,
    "colmap-text": _colmap,
    "colmap-binary": _colmap,
    "nerfstudio": _nerfstudio,
    "occupancy-grid": _occupancy_grid,
    "scene-graph": _scene_graph,
    "floor-plan": _floor_plan,
    "trajectory": _trajectory,
    "viewer": _viewer,
}
