"""Hole filling: Gaussians where no keyframe measured a depth, for renderings without black areas.

Sensors return no depth for shiny, dark, close and distant surfaces and at the border of the image.
Before the final refinement, such pixels are seeded at a depth inferred from the rendered depth
around them. Where another keyframe measured through the inferred point, the point is moved away
along its ray. The final refinement then fits its colour.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.densification import Densification, colour_noise
from toolkit.slam.mapping.depth_views import DepthView
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import SurfaceView

_log = logging.getLogger(__name__)

# Smaller holes are covered by the Gaussians around them, as a fraction of the image.
_MIN_HOLE = 0.002
# Factors of the inferred depth at which a point is tried, from near to far. A point that other
# keyframes measured through at all of them, as of the sky beside a roof, is behind everything: at
# this multiple of the farthest measured depth.
_DEPTH_FACTORS = (1.1, 1.25, 1.5, 2.0, 3.0)
_BEHIND_ALL = 1.5
# There is a depth edge beside a hole if the mean inverse depth around it exceeds the mean that is
# weighted by this power of the depth, and so dominated by the far surface, by this factor.
_DISTANCE_POWER = 6
_EDGE_RATIO = 1.2
# Width of the border of a hole that shows what is beside it, as a fraction of the image's width.
_BORDER = 0.01
# Largest width of the shadow beside a depth edge, as a fraction of the image's width.
_MAX_SHADOW = 0.06


def fill_all_holes(
    submap: Submap,
    view: Callable[[Submap, Keyframe], SurfaceView],
    densification: Densification,
) -> None:
    """Seed the holes of all keyframes of a map; see `fill_holes`.

    Args:
        view: renders the map from a keyframe.
    """
    depths = [DepthView.of(keyframe) for keyframe in submap.keyframes]
    filled = 0
    for number, keyframe in enumerate(submap.keyframes):
        others = [*depths[:number], *depths[number + 1 :]]
        rendered = view(submap, keyframe)
        filled += fill_holes(submap, keyframe, rendered, densification, others)
    if filled:
        _log.info("Seeded %d Gaussians where no depth was measured.", filled)


def fill_holes(
    submap: Submap,
    keyframe: Keyframe,
    view: SurfaceView,
    densification: Densification,
    others: Sequence[DepthView],
) -> int:
    """Seed the pixels of a keyframe that have neither a measured nor a rendered depth.

    Args:
        submap: the complete map, to which the Gaussians are added.
        view: the map rendered from the keyframe.
        densification: of the map; creates the Gaussians.
        others: depth of the other keyframes of the map.

    Returns:
        Number of Gaussians.
    """
    covered = densification.covered(view).cpu().numpy()
    holes = ~covered & ~(keyframe.depth_m.numpy() > 0)
    if keyframe.transient is not None:
        holes &= ~keyframe.transient.numpy()
    if holes.mean() < _MIN_HOLE or not covered.any():
        return 0
    depth_m = inferred_depth(np.where(covered, view.depth_m.cpu().numpy(), 0.0))
    frame = replace(keyframe.as_frame(), depth_m=depth_m)
    if frame.labels is not None:
        frame = replace(frame, labels=_nearest_labels(frame.labels))
    noise = colour_noise(view, keyframe, keyframe.images.to(view.depth_m.device))
    seeds = densification.seeds(frame, keyframe.T_map_camera, holes, noise)
    seeds = _outside_free_space(seeds, keyframe, others)
    if len(seeds):
        submap.append(seeds, keyframe)
    return len(seeds)


def inferred_depth(depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill the missing values of a depth image. At least one value must be present.

    A hole inside a surface is interpolated. A hole beside a depth edge is the shadow that the near
    surface casts on the far one, so it continues the far one. Only the border of a hole counts: an
    open door or a mirror some way off a dark screen says nothing about the screen.

    Args:
        depth_m: [H, W] in metres, 0 where missing.

    Returns:
        [H, W] in metres, positive everywhere and unchanged where it was present.
    """
    known = depth_m > 0
    inverse = np.divide(1.0, depth_m, out=np.zeros(depth_m.shape, np.float32), where=known)
    weight, reach = known.astype(np.float32), _reach(known)
    border = weight * _beside_holes(known)
    near_and_far = _mean_around(inverse, border, reach)
    far = _mean_around(inverse, border * depth_m**_DISTANCE_POWER, reach)
    at_edge = near_and_far > _EDGE_RATIO * far
    filled = np.where(at_edge, far, _interpolated(inverse, weight))
    return np.divide(1.0, filled, out=depth_m.astype(np.float32), where=~known)


def _interpolated(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill values [H, W] whose weight is 0 from the smallest cells of a pyramid with values."""
    if (weight > 0).all() or values.size == 1:
        return values
    height, width = values.shape
    half = ((width + 1) // 2, (height + 1) // 2)
    total = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(values * weight, half, interpolation=cv2.INTER_AREA)
    mean = np.divide(mean, total, out=np.zeros_like(mean), where=total > 0)
    coarse = cv2.resize(_interpolated(mean, total), (width, height))
    return np.where(weight > 0, values, coarse)


def _beside_holes(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask [H, W] of the missing pixels and the border around them."""
    side = 2 * max(1, round(_BORDER * known.shape[1])) + 1
    return np.asarray(cv2.dilate((~known).astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def _reach(known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Half the width [H, W] of the hole around each missing pixel; 0 where known [H, W]."""
    distance = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5)
    # A window must reach the other side of a shadow: its half width counts, not the distance.
    side = 2 * round(_MAX_SHADOW * known.shape[1] / 2) + 1
    return np.asarray(cv2.dilate(distance, np.ones((side, side), np.uint8)) * ~known, np.float32)


def _mean_around(
    values: NDArray[np.float32], weight: NDArray[np.float32], reach: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Mean [H, W] of weighted values around each missing pixel, over four times its reach."""
    height, width = values.shape
    weighted, mean = values * weight, np.zeros_like(values)
    below, cell = 0.0, 4
    while below < reach.max():
        pixels = (reach > below) & (reach <= cell / 4)
        size = (-(-width // cell), -(-height // cell))
        cells = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (weighted, weight))
        total, weights = (cv2.resize(a, (width, height)) for a in cells)
        mean[pixels] = total[pixels] / weights[pixels]
        below, cell = cell / 4, 2 * cell
    return mean


def _nearest_labels(labels: NDArray[np.int32]) -> NDArray[np.int32]:
    """Labels [H, W] in which each unlabelled pixel has the label of the nearest labelled one."""
    if not (labels > 0).any():
        return labels
    unlabelled = (labels == 0).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(
        unlabelled, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_number = np.zeros(nearest.max() + 1, labels.dtype)
    by_number[nearest[labels > 0]] = labels[labels > 0]
    return by_number[nearest]


def _outside_free_space(
    seeds: GaussianCloud, keyframe: Keyframe, others: Sequence[DepthView]
) -> GaussianCloud:
    """Move Gaussians away from their keyframe until no other keyframe measured through them."""
    empty = _measured_through(seeds.means, others)
    if not empty.any():
        return seeds
    moved, centre = seeds.select(empty), seeds.means.new_tensor(keyframe.T_map_camera[:3, 3])
    factors = seeds.means.new_tensor(_DEPTH_FACTORS)
    points = centre + factors[:, None, None] * (moved.means - centre)
    still_empty = _measured_through(points.reshape(-1, 3), others).reshape(points.shape[:2])
    # The first factor that no keyframe contradicts: argmax returns the first maximum.
    chosen = factors[(~still_empty).int().argmax(dim=0)]
    forward = moved.means.new_tensor(keyframe.T_map_camera[:3, 2])
    depth_m = (moved.means - centre) @ forward
    far_m = _BEHIND_ALL * max(float(view.depth_m.max()) for view in others)
    chosen = torch.where(still_empty.all(dim=0), (far_m / depth_m).clamp(min=1.0), chosen)
    moved = replace(
        moved,
        means=centre + chosen[:, None] * (moved.means - centre),
        log_radii=moved.log_radii + chosen.log(),
    )
    moved = moved.select(~_measured_through(moved.means, others))
    return GaussianCloud.concatenate([seeds.select(~empty), moved])


def _measured_through(points: Tensor, views: Sequence[DepthView]) -> Tensor:
    """Mask [N] of the points [N, 3] that any view measured through."""
    empty = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        empty |= view.measures_through(points)
    return empty
