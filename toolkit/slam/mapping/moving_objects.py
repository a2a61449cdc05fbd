"""Moving objects: pixels of a keyframe that contradict what earlier keyframes saw are not mapped.

Such pixels show a surface in space that several earlier keyframes measured as empty, in another
colour than the map behind it. They form regions of some size, and the rest of the image agrees with
the map: otherwise the pose or the depth is wrong. Their depth is removed from the keyframe and
their colour is not fitted. Objects that were mapped before they moved are removed with the
Gaussians in free space (`free_space.py`). An object that stays at its place becomes part of the
map.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.geometry.free_space import free_space_margin_m
from toolkit.base.keyframe import Keyframe, evenly_spaced
from toolkit.slam.mapping.depth_views import DepthView
from toolkit.slam.mapping.free_space import Evidence
from toolkit.splatting.rendering import SurfaceView
from toolkit.splatting.rendering.output import COLOUR

_Mask = NDArray[np.bool_]

# Minimum fraction of the image that a region covers, and maximum fraction of the mapped pixels in
# front of the map: beyond it, the pose is in doubt and nothing is left out.
_MIN_AREA, _MAX_AREA = 0.003, 0.4
# Minimum sum of the confidences of the earlier keyframes that measured through a region.
_MIN_THROUGH = 2.0
# Time after which an object that has stayed at its place is mapped.
_MAX_STILL_S = 3.0
# Factor of the median depth error, which exceeds the noise where the pose has drifted.
_DEPTH_FACTOR = 10.0
# Minimum colour difference of a region, as the median over its pixels, and as a factor of the
# median over the rest of the image.
_MIN_COLOUR, _COLOUR_FACTOR = 0.05, 2.0
# Minimum fraction of a region's pixels that earlier keyframes contradict.
_MIN_CONTRADICTED = 0.5
# Maximum displacement of a known surface in the image, as a fraction of the image's width.
_DISPLACEMENT = 0.05
# A region is tested at about this many of its pixels, against this many of the keyframes that show
# at least half of them.
_SAMPLES, _MAX_VIEWS = 400, 8
# A fraction of the evidence suffices for an object that was hidden in a keyframe of the last second
# and is within this distance of its former place, at this speed.
_KNOWN_EVIDENCE, _KNOWN_S, _KNOWN_M, _KNOWN_M_S = 0.25, 1.0, 0.2, 2.0
# Regions are enlarged by this fraction of the image's width: edges, blur, and limbs beside them.
_BORDER = 0.015


def hide_moving_objects(
    keyframe: Keyframe,
    view: SurfaceView,
    others: Sequence[Keyframe],
    min_silhouette: float,
) -> None:
    """Remove moving objects from a new keyframe; see `Keyframe.hide`.

    Args:
        view: the map rendered from the keyframe.
        others: earlier keyframes of the same map.
        min_silhouette: of the pixels that the map covers.
    """
    # Depth from priors and from neighbouring keyframes is least certain where objects move.
    if not others or keyframe.prior_m is not None:
        return
    measured_m, map_m = keyframe.measured_m, view.depth_m.cpu()
    mapped = (view.output.silhouette >= min_silhouette).cpu()
    covered = mapped & (measured_m > 0)
    nearer = _nearer_than_map(measured_m, map_m - measured_m, covered)
    if nearer is None:
        return
    map_m = torch.where(mapped, map_m, torch.inf)
    new = nearer & ~_displaced(measured_m.numpy(), map_m.numpy())
    regions = _regions(new)
    if not regions:
        return
    difference = _colour_difference(keyframe, view)
    usual = float(np.median(difference[~nearer]))
    limit = max(_MIN_COLOUR, _COLOUR_FACTOR * usual)
    mask = np.zeros(nearer.shape, bool)
    for region in regions:
        if np.median(difference[region]) > limit and _has_moved(region, keyframe, others):
            mask |= _continued(region, nearer)
    if mask.any():
        mask = _dilated(mask)
        # Its outline, where depth is missing or flies.
        mask |= _dilated(mask) & (nearer | (measured_m.numpy() == 0))
        keyframe.hide(torch.from_numpy(mask))


def _nearer_than_map(depth_m: Tensor, behind_m: Tensor, covered: Tensor) -> _Mask | None:
    """Mask [H, W] of the pixels measured in front of the map; None if too few or too many are.

    Args:
        depth_m: [H, W] measured depth. behind_m: [H, W] depth of the map less the measured one.
        covered: [H, W] the pixels with both.
    """
    floor = free_space_margin_m(depth_m)
    if int((covered & (behind_m > floor)).sum()) < _MIN_AREA * depth_m.numel():
        return None
    median = float(behind_m[covered].abs().median())
    nearer = covered & (behind_m > floor.clamp(min=_DEPTH_FACTOR * median))
    if int(nearer.sum()) > _MAX_AREA * int(covered.sum()):
        return None
    return np.asarray(nearer.numpy())


def _colour_difference(keyframe: Keyframe, view: SurfaceView) -> NDArray[np.float32]:
    """Mean absolute difference [H, W] of the channels between keyframe and map."""
    rendered = view.images[COLOUR].cpu()
    return np.asarray((rendered - keyframe.target_rgb()).abs().mean(dim=0).numpy())


def _regions(mask: _Mask) -> list[_Mask]:
    """Regions of a mask [H, W] that are large enough, narrow gaps included."""
    # Bands along depth edges are thin.
    solid = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    # Limbs are separated by pixels without depth along their edges.
    count, numbers = cv2.connectedComponents(_dilated(solid > 0).astype(np.uint8))
    regions = ((numbers == number) & (solid > 0) for number in range(1, count))
    return [region for region in regions if region.sum() >= _MIN_AREA * mask.size]


def _dilated(mask: _Mask) -> _Mask:
    """A mask [H, W] enlarged by the border of moving objects."""
    radius = max(1, round(_BORDER * mask.shape[1]))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _displaced(depth_m: NDArray[np.float32], map_m: NDArray[np.float32]) -> _Mask:
    """Mask [H, W] of measured depths that the map [H, W] has nearby: the pose may be wrong."""
    side = 2 * round(_DISPLACEMENT * depth_m.shape[1]) + 1
    nearest_m = cv2.erode(map_m, np.ones((side, side), np.uint8))
    return np.asarray(nearest_m - depth_m <= free_space_margin_m(depth_m))


def _continued(region: _Mask, nearer: _Mask) -> _Mask:
    """A region [H, W] with the pixels in front of the map that continue it, however scattered."""
    # Behind glass, for instance, the map has gaps.
    _, numbers = cv2.connectedComponents(_dilated(nearer).astype(np.uint8))
    return np.asarray(nearer & np.isin(numbers, np.unique(numbers[region])))


def _has_moved(region: _Mask, keyframe: Keyframe, others: Sequence[Keyframe]) -> bool:
    """Whether earlier keyframes saw through the surface in a region, and it has not stayed."""
    rows, columns = np.nonzero(region)
    every = max(1, len(rows) // _SAMPLES)
    rows, columns = rows[::every], columns[::every]
    points = keyframe.camera.unproject(keyframe.depth_m.numpy())[rows, columns]
    points_map = se3.transform_points(keyframe.T_map_camera, points)
    showing = [other for other in others if other.shows(points_map).mean() >= 0.5]
    if not showing:
        return False
    means = torch.from_numpy(points_map.astype(np.float32))
    views = (DepthView.of(other) for other in evenly_spaced(showing, _MAX_VIEWS))
    evidence = Evidence.of(means, views, whole_map=False)
    known = _was_hidden(points_map, keyframe, others)
    min_through = _MIN_THROUGH * (_KNOWN_EVIDENCE if known else 1.0)
    empty = (evidence.through >= min_through) & (evidence.through > evidence.support)
    if float(empty.float().mean()) < _MIN_CONTRADICTED:
        return False
    held_s = _held_s(means, keyframe, showing, 2.0 * _MAX_STILL_S)
    return float(np.median(held_s)) < _MAX_STILL_S


def _was_hidden(
    points_map: NDArray[np.float64], keyframe: Keyframe, others: Sequence[Keyframe]
) -> bool:
    """Whether the object at points [N, 3] was hidden in the last keyframe that hides any."""
    for other in reversed(others):
        age_s = keyframe.timestamp_s - other.timestamp_s
        if age_s > _KNOWN_S:
            break
        if other.transient is not None and other.observed_m is not None:
            hidden_m = other.observed_m.masked_fill(~other.transient, 0.0).numpy()
            hidden = other.camera.unproject(hidden_m)[hidden_m > 0]
            hidden_map = se3.transform_points(other.T_map_camera, hidden)
            # Without the border, which shows what is behind.
            low, high = np.quantile(hidden_map, [0.1, 0.9], axis=0)
            reach_m = _KNOWN_M + _KNOWN_M_S * age_s
            middle = np.median(points_map, axis=0)
            return bool(((middle > low - reach_m) & (middle < high + reach_m)).all())
    return False


def _held_s(
    means: Tensor, keyframe: Keyframe, others: Sequence[Keyframe], longest_s: float
) -> NDArray[np.float64]:
    """Time [N] in seconds for which points [N, 3] were on a surface until now, moving or not."""
    held_s, ended = np.zeros(len(means)), np.zeros(len(means), bool)
    for other in reversed(others):
        age_s = keyframe.timestamp_s - other.timestamp_s
        if age_s > longest_s:
            break
        depth_m = other.depth_m if other.observed_m is None else other.observed_m
        view = DepthView.of(other)
        chosen, pixel, z = (a.numpy() for a in view.pixels_of(means))
        depth = depth_m.numpy().reshape(-1)[pixel]
        margin = free_space_margin_m(depth)
        ended[chosen[z < depth - margin]] = True
        near = chosen[(depth > 0) & (np.abs(z - depth) <= margin)]
        near = near[~ended[near]]
        held_s[near] = age_s
    return held_s
