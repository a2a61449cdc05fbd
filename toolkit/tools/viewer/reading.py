"""Describe finished runs and splat files for the viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import RunFolderError
from toolkit.base.geometry.image_sides import ImageSide, mean_up, up_in_camera
from toolkit.exports.selection import SelectedGaussians, ground_of, select
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import Splats, is_splat_file, read_splats
from toolkit.runs.evaluation.frame_states import summary_lines
from toolkit.runs.evaluation.run_loops import accepted_edges
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.labelled import taxonomy_of_file
from toolkit.slam.loops.log import read_loop_log
from toolkit.tools.viewer.keyframes import shown_keyframes
from toolkit.tools.viewer.options import ShownContent
from toolkit.tools.viewer.scene import ShownLoop, ShownSplats, ShownTree, ViewerScene, path_states
from toolkit.tools.viewer.shapes import shape_columns
from toolkit.tools.viewer.shown_objects import read_graph_objects


def read_scene(path: Path, content: ShownContent, whole: bool = False) -> ViewerScene:
    """Describe what a viewer shows of a finished run or of a splat file.

    The objects are those of the scene graph that grew during the run, if it kept one.

    Args:
        path: run folder, or a splat file.
        content: what is shown.
        whole: return all Gaussians, in the order of the map, whatever their maximum number.

    Raises:
        ToolkitError: there is no finished run, one of its files is damaged, or the file is not a
            splat file.
    """
    if not is_splat_file(path) and path.exists():
        scene = run_scene(select(path), content, whole)
        return replace(scene, objects=read_graph_objects(RunFolder(path).scene_graph))
    if not path.exists():
        raise RunFolderError(f"{path} does not exist; give a run folder or a splat file")
    scene = file_scene(path)
    return scene if whole else scene.thinned(content.max_gaussians)


def run_scene(
    selection: SelectedGaussians, content: ShownContent, whole: bool = False
) -> ViewerScene:
    """Describe the selected Gaussians of a finished run, with its cameras and loops.

    Args:
        selection: the Gaussians.
        content: what is shown.
        whole: return all Gaussians, in the order of the map, whatever their maximum number.
    """
    run, gaussians = selection.run, selection.gaussians
    labels = selection.labels
    tree = None
    if labels is not None:
        tree = ShownTree.from_taxonomy(selection.labelled().taxonomy)
    splats = ShownSplats(
        means_m=gaussians.means.numpy(),
        sigmas_m=gaussians.radii_m.numpy(),
        opacities=gaussians.opacities.numpy(),
        rgb=selection.rgb,
        **shape_columns(gaussians.ellipsoids),
        levels=None if labels is None else labels.levels,
        confidence=None if labels is None else labels.confidence,
        submap=None if selection.submap is None else selection.submap.astype(np.int32),
    )
    if not whole:
        splats = splats.thinned(content.max_gaussians, run.trajectory.positions_m)
    keyframes = shown_keyframes(run, splats, content)
    return ViewerScene(
        title=run.folder.path.resolve().name,
        splats=keyframes.splats,
        total=len(gaussians),
        up=_up(run),
        tree=tree,
        path=run.trajectory.T_world_camera,
        path_states=path_states(
            [frame.index for frame in run.tracked],
            {state.index for state in run.states if state.state == "doubtful"},
            {state.index for state in run.states if state.part != 0},
        ),
        keyframes=keyframes.keyframes,
        camera=run.camera,
        loops=loops_between(
            run.folder.loops, {f.index: f.T_map_camera[:3, 3] for f in run.tracked}
        ),
        notes=(*summary_lines(run.states, run.parts), *run.length_names.notes),
        length=run.length_names.length,
    )


def file_scene(path: Path) -> ViewerScene:
    """Describe all of a splat file, with classes if its labels have a taxonomy or one is beside."""
    splats = read_splats(path)
    shown = _file_splats(splats)
    taxonomy = taxonomy_of_file(path, splats)
    tree = None if taxonomy is None else ShownTree.from_taxonomy(taxonomy)
    if tree is None:
        shown = ShownSplats(
            **{k: v for k, v in shown.columns().items() if k not in ("levels", "confidence")}
        )
    names = LengthNames.of_comments(splats.comments)
    return ViewerScene(
        path.name, shown, len(splats), tree=tree, notes=names.notes, length=names.length
    )


def _file_splats(splats: Splats) -> ShownSplats:
    labels, submap = splats.labels, splats.extra.get("submap")
    with np.errstate(over="ignore"):
        opacities = 1.0 / (1.0 + np.exp(-splats.opacity_logits))
    return ShownSplats(
        means_m=splats.means,
        sigmas_m=np.exp(splats.log_radii),
        opacities=opacities.astype(np.float32),
        rgb=np.rint(255.0 * np.clip(splats.colours, 0.0, 1.0)).astype(np.uint8),
        **shape_columns(splats.ellipsoids),
        levels=None if labels is None else labels.levels,
        confidence=None if labels is None else labels.confidence,
        submap=None if submap is None else submap.astype(np.int32),
    )


def _up(run: FinishedRun) -> NDArray[np.float64]:
    """Return the vertical: the normal of the floor, otherwise that of the cameras."""
    ground = ground_of(run)
    if ground is not None:
        return ground.up
    return vertical(run.trajectory.T_world_camera, run.up_side)


def vertical(poses: NDArray[np.float64], side: ImageSide) -> NDArray[np.float64]:
    """Return the mean vertical [3] of cameras T_map_camera [M, 4, 4] with a side up."""
    if not len(poses):
        return up_in_camera(side)
    up = mean_up(poses, side)
    return up / max(float(np.linalg.norm(up)), 1e-9)


def loops_between(
    log: Path, positions_m: Mapping[int, NDArray[np.float64]]
) -> tuple[ShownLoop, ...]:
    """Return the verified loops between frames with a position [3], from `loops.jsonl`."""
    if not log.is_file():
        return ()
    loops = []
    for record in accepted_edges(read_loop_log(log)):
        first, second = int(record.get("match", -1)), int(record.get("query", -1))
        if first in positions_m and second in positions_m:
            ends_m = np.stack([positions_m[first], positions_m[second]])
            loops.append(ShownLoop(first, second, ends_m))
    return tuple(loops)
