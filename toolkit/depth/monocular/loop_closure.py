"""Correction of a monocular map by the places that the camera visits again.

Revisits become edges of a similarity graph, because the scale of a monocular map drifts. Bundle
adjustment with the keypoints that views far apart have in common follows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.similarity import SimilarityEdge, solve_similarities
from toolkit.depth.monocular.revisits import (
    Matches,
    Revisit,
    ViewKeypoints,
    find_keypoints,
    find_revisits,
    keypoint_points,
    reprojection_px,
    triangulated,
)
from toolkit.depth.monocular.visual_odometry.scale_drift import scale_sigma
from toolkit.depth.monocular.visual_odometry.sparse_map import MAX_ERROR_PX, PointTracks, SparseMap
from toolkit.semantics.features.keypoints import Keypoints

Array = NDArray[np.float64]

# Standard deviations between consecutive views: rotations in pixels, translations relative to the
# depth of the scene. Where image points hardly determine the scale, it deviates by as many image
# errors: drift through turns is systematic.
_ROTATION_PX, _TRANSLATION, _LOG_SCALE = 1.5, 0.01, 0.01
_ERRORS_PX = 4.0
_MAX_LOG_SCALE = 1.0
_RESTARTED = 10.0
# Of a revisit.
_REVISIT_ROTATION_RAD, _REVISIT_TRANSLATION, _REVISIT_LOG_SCALE = 0.005, 0.02, 0.01
# A revisit that contradicts odometry by more standard deviations shows a similar place instead,
# or odometry has failed. True ones have up to 4.5, those of identical rooms 3 to 8.
_MAX_SIGMAS = 4.0
# Fraction of a revisit's matches that must fit in the end.
_MIN_FITTING = 0.5
_ATTEMPTS = 3
_ADJUSTMENTS = 3


@dataclass(frozen=True)
class LoopClosure:
    """Result of a correction.

    Attributes:
        revisits: accepted pairs of views.
        rejected: pairs that contradict the rest.
    """

    revisits: int = 0
    rejected: int = 0


def close_loops(
    sparse_map: SparseMap,
    image: Callable[[int], NDArray[np.uint8]],
    detected: dict[int, Keypoints] | None = None,
) -> tuple[SparseMap, LoopClosure]:
    """Correct a map by revisits.

    Args:
        sparse_map: after bundle adjustment; not changed.
        image: returns the grey image [H, W] of a frame.
        detected: as `find_keypoints` has it.
    """
    keypoints = find_keypoints(sparse_map.camera, sparse_map.views, image, detected)
    found = find_revisits(sparse_map.camera, keypoints)
    sequence = _sequence(sparse_map)
    accepted = [revisit for revisit in found if _plausible(sparse_map, sequence, revisit)]
    corrected, scaled = _corrected(sparse_map, keypoints, sequence, accepted)
    for _ in range(_ATTEMPTS):
        fitting = [revisit for revisit in accepted if _fits(corrected, scaled, revisit)]
        if len(fitting) == len(accepted):
            break
        accepted = fitting
        corrected, scaled = _corrected(sparse_map, keypoints, sequence, accepted)
    return corrected, LoopClosure(len(accepted), len(found) - len(accepted))


def _sequence(sparse_map: SparseMap) -> list[SimilarityEdge]:
    """Edges between consecutive views."""
    views = sparse_map.views
    drift = np.clip(_ERRORS_PX * scale_sigma(sparse_map), _LOG_SCALE, _MAX_LOG_SCALE)
    depth = _median_depth(sparse_map)
    rotation_rad = _ROTATION_PX / sparse_map.camera.focal
    edges = []
    for n, sigma in enumerate(drift):
        T = se3.inverse(views[n].T_world_camera) @ views[n + 1].T_world_camera
        translation = _TRANSLATION * depth * sigma / _LOG_SCALE
        # Where odometry began again, a revisit has given the relative pose.
        turned = rotation_rad * (_RESTARTED if sigma == _MAX_LOG_SCALE else 1.0)
        edges.append(SimilarityEdge(n, n + 1, T, 1.0, turned, translation, float(sigma)))
    return edges


def _median_depth(sparse_map: SparseMap) -> float:
    inverse_depth = sparse_map.table.inverse_depth[sparse_map.table.measured]
    return 1.0 / float(np.median(inverse_depth))


def _edge(sparse_map: SparseMap, revisit: Revisit) -> SimilarityEdge:
    return SimilarityEdge(
        revisit.first,
        revisit.second,
        se3.inverse(revisit.T_second_first),
        1.0 / revisit.scale,
        _REVISIT_ROTATION_RAD,
        _REVISIT_TRANSLATION * _median_depth(sparse_map),
        max(_REVISIT_LOG_SCALE, revisit.log_scale_sigma),
        robust=True,
    )


def _plausible(sparse_map: SparseMap, sequence: Sequence[SimilarityEdge], revisit: Revisit) -> bool:
    """Whether the drift of the odometry can explain what a revisit finds."""
    views = sparse_map.views[revisit.first : revisit.second + 1]
    between = sequence[revisit.first : revisit.second]
    expected = se3.inverse(views[-1].T_world_camera) @ views[0].T_world_camera
    centres = np.array([view.T_world_camera[:3, 3] for view in views])
    reach = float(np.linalg.norm(centres - centres[0], axis=1).max())
    rotation = np.sqrt(sum(edge.rotation_sigma_rad**2 for edge in between))
    log_scale = np.sqrt(sum(edge.log_scale_sigma**2 for edge in between))
    along = sum(edge.translation_sigma**2 for edge in between)
    translation = np.sqrt(along + (reach * rotation) ** 2 + (reach * log_scale) ** 2)
    difference = expected[:3, 3] - revisit.scale * revisit.T_second_first[:3, 3]
    turned = se3.rotation_angle_rad(expected[:3, :3].T @ revisit.T_second_first[:3, :3])
    return bool(
        turned < _MAX_SIGMAS * rotation
        and abs(np.log(revisit.scale)) < _MAX_SIGMAS * log_scale
        and np.linalg.norm(difference) < _MAX_SIGMAS * translation
    )


def _corrected(
    sparse_map: SparseMap,
    keypoints: ViewKeypoints,
    sequence: Sequence[SimilarityEdge],
    revisits: Sequence[Revisit],
) -> tuple[SparseMap, ViewKeypoints]:
    """A corrected copy, and the keypoints triangulated in it."""
    corrected = sparse_map.copy()
    edges = [*sequence, *(_edge(sparse_map, revisit) for revisit in revisits)]
    poses = [view.T_world_camera for view in sparse_map.views]
    scale = np.ones(len(poses))
    if revisits:
        solution = solve_similarities(poses, edges)
        poses, scale = solution.T_world_node, solution.scale
        corrected.transform(poses, scale)
    scaled = ViewKeypoints(
        keypoints.views,
        [depth / s for depth, s in zip(keypoints.inverse_depth, scale, strict=True)],
        keypoints.neighbours,
    )
    corrected.add(_tracks(corrected, scaled, revisits))
    for _ in range(_ADJUSTMENTS):
        corrected.adjust_all(clean=True)
    # Bundle adjustment changes the scale, too, as a whole and along the sequence.
    views = keypoints.views, keypoints.neighbours
    return corrected, triangulated(corrected.camera, corrected.views, *views)


def _fits(corrected: SparseMap, keypoints: ViewKeypoints, revisit: Revisit) -> bool:
    """Whether most matches of a revisit agree with the corrected poses."""
    good = _agree(corrected, keypoints, (revisit.first, revisit.second), revisit.matches)
    return bool(good.mean() > _MIN_FITTING)


def _tracks(
    sparse_map: SparseMap, keypoints: ViewKeypoints, revisits: Sequence[Revisit]
) -> PointTracks:
    """Points of the scene from keypoints that several views show."""
    counts = [len(view) for view in keypoints.views]
    starts = np.concatenate([[0], np.cumsum(counts)])
    links = [
        matches[_agree(sparse_map, keypoints, pair, matches)] + starts[list(pair)]
        for pair, matches in keypoints.neighbours.items()
    ]
    links += [r.matches + starts[[r.first, r.second]] for r in revisits]
    rows, columns = np.concatenate([np.zeros((0, 2), np.int64), *links]).T
    total = int(starts[-1])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(total, total))
    _, point = connected_components(graph, directed=False)
    view = np.repeat(np.arange(len(counts)), counts)
    inverse_depth = np.concatenate([np.zeros(0), *keypoints.inverse_depth])
    # A view shows a point once; two keypoints of it are different points.
    times = np.bincount(point)
    ambiguous = np.zeros(len(times), bool)
    order = np.lexsort((view, point))
    again = (np.diff(point[order]) == 0) & (np.diff(view[order]) == 0)
    ambiguous[point[order][1:][again]] = True
    known = np.flatnonzero(inverse_depth > 0)
    measured, first = np.unique(point[known], return_index=True)
    anchor = np.full(len(times), -1)
    anchor[measured] = known[first]
    use = (times > 1) & ~ambiguous & (anchor >= 0)
    new = np.cumsum(use) - 1
    shown = use[point]
    px = np.concatenate([np.zeros((0, 2)), *(image.px for image in keypoints.views)])
    chosen = anchor[use]
    return PointTracks(
        view[chosen].astype(np.int32),
        px[chosen],
        inverse_depth[chosen],
        new[point[shown]],
        view[shown],
        px[shown],
    )


def _agree(
    sparse_map: SparseMap, keypoints: ViewKeypoints, pair: tuple[int, int], matches: Matches
) -> NDArray[np.bool_]:
    """Which matches of two views fit the depth of the first one."""
    first, second = pair
    known = keypoints.inverse_depth[first][matches[:, 0]] > 0
    T_world_first, T_world_second = (sparse_map.views[n].T_world_camera for n in pair)
    good = known.copy()
    local = keypoint_points(sparse_map.camera, keypoints, first, matches[known, 0])
    points = se3.transform_points(se3.inverse(T_world_second) @ T_world_first, local)
    px = keypoints.views[second].px[matches[known, 1]]
    good[known] = reprojection_px(sparse_map.camera, points, px) < MAX_ERROR_PX
    return good
