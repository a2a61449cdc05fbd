"""Pictures of a report: classes by level, floor plan, loops, and the graph of the submaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry.frustum import Frustum, far_depth_m, observed_points
from toolkit.datasets.base import Dataset
from toolkit.io.length_names import LengthNames
from toolkit.io.splats import read_splats
from toolkit.runs.evaluation.loop_gallery import LoopPicture, gallery_pairs
from toolkit.runs.evaluation.report import LevelImage, ReportFloorPlan
from toolkit.runs.evaluation.submap_graph import (
    SubmapGraph,
    SubmapViews,
    observed_from,
    submap_links,
)
from toolkit.runs.maps.splat_clouds import cloud_of
from toolkit.scene.graph.floor_plan import (
    PlanDrawing,
    PlanEdge,
    PlanNode,
    draw_floor_plans,
    floor_plans,
    total_areas,
)
from toolkit.scene.query import LabelledMap
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.loops.log import read_loop_log
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
    file: Path,
    taxonomy: Taxonomy,
    cameras_m: NDArray[np.float64],
    names: LengthNames,
    graph: dict[str, Any] | None = None,
) -> ReportFloorPlan | None:
    """Draw the floor plan of each storey of a labelled map.

    Args:
        file: the splats of the map with labels.
        taxonomy: taxonomy of the labels.
        cameras_m: [P, 3] positions of the camera in the frame of the map.
        names: of lengths.
        graph: scene graph in node-link format, which is drawn over the plan; None for none.

    Returns:
        The floor plan, None if the map has no labels or no floor was found.
    """
    splats = read_splats(file)
    opaque = splats.opacity_logits >= np.log(_MIN_OPACITY / (1 - _MIN_OPACITY))
    if splats.labels is None or not opaque.any():
        return None
    means_m = splats.means[opaque].astype(np.float64)
    labelled = LabelledMap(means_m, splats.labels.select(opaque), taxonomy)
    floors = labelled.floors()
    if floors is None:
        return None
    palette = Palette(taxonomy)
    radii_m = cloud_of(splats).select(torch.from_numpy(opaque)).radii_seen_m(floors.ground.up)
    plans = floor_plans(labelled, radii_m, floors, cameras_m, palette)
    drawings = [] if graph is None else _graph_drawing(graph).by_storey(floors)
    image = draw_floor_plans(plans, palette, legend=False, names=names, drawings=drawings)
    return ReportFloorPlan(
        image, total_areas(plans), () if graph is None else _listed_objects(graph)
    )


def _graph_drawing(graph: dict[str, Any]) -> PlanDrawing:
    """The rooms, objects and relations of a scene graph in node-link format."""
    rooms = [node for node in graph["nodes"] if node["kind"] == "room"]
    places_m = {
        node["id"]: np.array(node["box"]["centre_m"])
        for node in graph["nodes"]
        if node["kind"] == "object"
    }
    doors_m = [door["place_m"] for room in rooms for door in room["doors"]]
    return PlanDrawing(
        [(room["name"], ()) for room in rooms],
        np.array([room["centre_m"] for room in rooms]).reshape(-1, 3),
        np.array(doors_m).reshape(-1, 3),
        np.empty((0, 3)),
        [PlanNode(str(number), place_m) for number, place_m in places_m.items()],
        [
            PlanEdge(edge["relation"], places_m[edge["source"]], places_m[edge["target"]])
            for edge in graph["edges"]
            if edge["source"] in places_m and edge["target"] in places_m
        ],
    )


def _listed_objects(graph: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Number, name and relations of each object of a scene graph in node-link format."""
    names = {
        node["id"]: f"{node['name']} ({node['id']})" if "box" in node else node["name"]
        for node in graph["nodes"]
    }
    relations: dict[Any, list[str]] = {}
    for edge in graph["edges"]:
        text = f"{edge['relation']} {names[edge['target']]}"
        relations.setdefault(edge["source"], []).append(text)
    return [
        (str(node["id"]), node["name"], ", ".join(relations.get(node["id"], ())))
        for node in graph["nodes"]
        if node["kind"] == "object"
    ]
