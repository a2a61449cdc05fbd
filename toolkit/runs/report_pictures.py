"""Pictures of a report: classes by level, floor plan, loops, and the graph of the submaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.datasets.base import Dataset
from toolkit.evaluation.loop_gallery import LoopPicture, gallery_pairs
from toolkit.evaluation.report import LevelImage, ReportFloorPlan
from toolkit.evaluation.submap_graph import (
    SubmapGraph,
    SubmapViews,
    observed_from,
    submap_links,
)
from toolkit.geometry.frustum import Frustum, far_depth_m, observed_points
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import read_splats
from toolkit.loops.log import read_loop_log
from toolkit.runs.folder import cloud_of
from toolkit.semantics.floor_plan import draw_floor_plan, floor_plan
from toolkit.semantics.palette import Palette
from toolkit.semantics.query import LabelledMap
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.result import SlamResult, SubmapSummary

# Pairs of each kind in the loop gallery.
_LOOP_PAIRS = 4
# Views of a submap and points of a view from which overlaps are computed.
_VIEWS, _POINTS = 8, 200
# With more submaps, the number of pairs grows too large for a drawing.
_MAX_SUBMAPS = 100
# Gaussians with a smaller opacity do not represent surfaces.
_MIN_OPACITY = 0.5


def level_images(palette: Palette, nodes: Sequence[NDArray[np.integer]]) -> list[LevelImage]:
    """Return the classes of a view at every level, coarsest first.

    Args:
        nodes: node indices [H, W] at each level, -1 where nothing was decoded.
    """
    return [
        LevelImage(name, palette.class_image(node_ids), palette.legend(node_ids))
        for name, node_ids in zip(palette.taxonomy.levels, nodes, strict=True)
    ]


def loop_pictures(log: Path, dataset: Dataset) -> list[LoopPicture]:
    """Return the loop gallery of a run; empty without loop candidates."""
    pairs = gallery_pairs(read_loop_log(log), _LOOP_PAIRS)
    return [LoopPicture(p, dataset[p.query].rgb, dataset[p.match].rgb) for p in pairs]


def submap_graph(result: SlamResult, dataset: Dataset) -> SubmapGraph | None:
    """Return the graph of the main part's submaps.

    None if there is only one, or more than can be drawn.
    """
    drawn = [submap for submap in result.submaps if submap.number in result.parts[0]]
    if not 2 <= len(drawn) <= _MAX_SUBMAPS:
        return None
    poses = dict(zip(result.frame_indices, result.trajectory.T_world_camera, strict=True))
    submaps = [_views(submap, poses, dataset) for submap in drawn]
    loops = [(e.first, e.second) for e in result.loops if e.first in result.parts[0]]
    path_m = result.trajectory.positions_m[:, [0, 2]]
    return SubmapGraph(submaps, submap_links(submaps, loops), path_m)


def _views(
    submap: SubmapSummary, poses: dict[int, NDArray[np.float64]], dataset: Dataset
) -> SubmapViews:
    # Keyframes of a loaded map are not in the dataset of this run.
    keyframes = [index for index in submap.keyframe_indices if index >= 0 and index in poses]
    chosen = np.linspace(0, len(keyframes) - 1, min(_VIEWS, len(keyframes))).round().astype(int)
    points_m, frusta = [np.empty((0, 3))], []
    for index in (keyframes[i] for i in chosen):
        frame = dataset[index]
        points = observed_points(frame.camera, frame.depth_m, _POINTS)
        points_m.append(observed_from(points, poses[index]))
        if len(points_m[-1]):
            frusta.append(Frustum(frame.camera, poses[index], far_m=far_depth_m(frame.depth_m)))
    positions_m = [poses[index][:3, 3] for index in keyframes] or [submap.T_world_submap[:3, 3]]
    return SubmapViews(
        submap.number,
        len(submap.keyframe_indices),
        np.mean(positions_m, axis=0)[[0, 2]],
        np.concatenate(points_m),
        frusta,
    )


def report_floor_plan(
    file: Path, taxonomy: Taxonomy, cameras_m: NDArray[np.float64], names: LengthNames
) -> ReportFloorPlan | None:
    """Draw the floor plan of a labelled map.

    Args:
        file: the splats of the map with labels.
        taxonomy: taxonomy of the labels.
        cameras_m: [P, 3] positions of the camera in the frame of the map.
        names: of lengths.

    Returns:
        The floor plan, None if the map has no labels or no floor was found.
    """
    splats = read_splats(file)
    opaque = splats.opacity_logits >= np.log(_MIN_OPACITY / (1 - _MIN_OPACITY))
    if splats.labels is None or not opaque.any():
        return None
    means_m = splats.means[opaque].astype(np.float64)
    labelled = LabelledMap(means_m, splats.labels.select(opaque), taxonomy)
    ground = labelled.ground()
    if ground is None:
        return None
    palette = Palette(taxonomy)
    radii_m = cloud_of(splats).select(torch.from_numpy(opaque)).radii_seen_m(ground.up)
    plan = floor_plan(labelled, radii_m, ground, cameras_m, palette)
    return ReportFloorPlan(draw_floor_plan(plan, palette, legend=False, names=names), plan.areas)
